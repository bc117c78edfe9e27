"""Control points: surveyed points that images show, which judge the map in metres and place it in the survey."""
