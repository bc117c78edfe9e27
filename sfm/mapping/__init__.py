"""From verified pairs to models: attempts, mappers, held-out matches."""
