"""Poses that a data set states instead of VIO: the map in their frame, and how SfM's models agree with them."""
