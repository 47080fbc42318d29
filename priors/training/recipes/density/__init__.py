"""Settings and trainer of a density, and the variants that are compared."""
