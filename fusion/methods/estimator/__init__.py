"""What `drift_aware` and `smoother` fit: a chain of keyframes with heavy-tailed, correlated prediction errors."""
