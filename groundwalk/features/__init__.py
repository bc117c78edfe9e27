"""Local features of an image: used by sfm and localise."""
