"""Fits the simulator's model of VIO drift to recordings of phones."""
