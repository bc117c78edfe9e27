"""Is a motion what VIO says? Estimates held against limits, scale and residuals over windows of path, and what is
wrong where images and VIO disagree: pure functions on arrays, no files."""
