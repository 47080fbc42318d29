"""The path of the live viewer: points on the ground that can be dragged, the file it is kept in, and its controls."""
