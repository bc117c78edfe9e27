"""Structure from motion: one COLMAP model over all sessions of a scene, and how good it is."""
