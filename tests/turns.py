"""Rotations by textbook matrices, independent of the code under test."""

import numpy as np


def turn(axis: int, degrees: float) -> np.ndarray:
    """Rotation matrix about one axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(np.radians(degrees))
    matrix[j, i] = np.sin(np.radians(degrees))
    matrix[i, j] = -matrix[j, i]
    return matrix
