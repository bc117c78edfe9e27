"""Motion by images against motion by VIO: estimates against limits, scale and residuals over windows of path, and the
cause where they are inconsistent: pure functions on arrays, no files."""
