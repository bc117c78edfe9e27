"""Checks of a recording: rows, images, clock, and the convention of its poses."""
