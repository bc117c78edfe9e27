"""Ground truth as other tools read it, and regressors as phones run them."""
