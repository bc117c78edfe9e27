"""Ground truth for other tools: COLMAP, TUM, nerfstudio, 7-Scenes and Cambridge Landmarks layouts."""
