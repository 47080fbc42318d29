"""USD files by the package usd-core."""
