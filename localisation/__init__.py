"""Localising single images by structure: a compact map of points (`Map`), and the baseline HLoc."""
