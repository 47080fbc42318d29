"""Endings of file formats that several modules ask about, some of which are slow to import."""

USD_WRITTEN = (".usda", ".usdc", ".usd")
"""Endings of USD files that are written."""
