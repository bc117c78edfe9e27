"""Which pairs of frames are matched, their matches, and their relative poses against VIO."""
