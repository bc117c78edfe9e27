"""Lenses, rolling shutter and focal lengths: before mapping, and adjusted with a model."""
