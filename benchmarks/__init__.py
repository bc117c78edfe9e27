"""What the toolkit costs, measured in one run against a named peer or a physical limit."""
