"""Rulers: printed boards and known distances in the images, which judge the map's scale, or set it."""
