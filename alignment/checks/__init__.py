"""Consistency checks before ground truth is given out: each compares one estimate with its limit."""
