"""How the live viewer looks: theme, ground and light, and where the camera is."""
