"""Errors of poses, accuracy levels and frame sets."""
