"""A model's quality: covariance, residuals, and its motion against VIO."""
