"""Stage `align`: from a model in SfM's gauge to ground truth in a metric map with +y up, and how VIO drifts from it."""
