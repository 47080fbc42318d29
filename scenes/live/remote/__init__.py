"""Orders from other programs."""
