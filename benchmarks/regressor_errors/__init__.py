"""A model of regressors' errors, matched to published tables, for fusion benchmarks without training."""
