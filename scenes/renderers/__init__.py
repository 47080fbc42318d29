"""Painters of pictures: shaded bodies by OpenGL, or stick figures."""

STICK_FIGURES = "matplotlib (stick figures)"
"""Name of the painter that works everywhere; its module needs matplotlib."""
