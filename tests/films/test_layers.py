"""Layers of a picture: what one sees through comes last, the furthest first, and does not make the rest sheer."""

import numpy as np

from mapctl.mesh.primitives import Surface
from scenes.renderers.layers import Layer, list_layers

EYE = np.array([0.0, 0.0, 10.0])
FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def triangles(depths, opacities, *, is_open=True) -> Surface:
    """One triangle at each depth before the eye."""
    vertices = np.concatenate([FLAT - np.array([0.0, 0.0, depth]) for depth in depths])
    rgba = np.repeat([[0.2, 0.4, 0.6, opacity] for opacity in opacities], 3, axis=0)
    faces = np.arange(3 * len(depths)).reshape(-1, 3)
    return Surface(vertices, faces, rgba, np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), is_open=is_open)


def test_sheer_triangles_of_all_bodies_are_sorted_over_the_ground():
    ground = Surface(FLAT, np.array([[0, 1, 2]]), np.ones((3, 4)))
    bodies = [triangles([1, 4, 2], [0.5, 0.5, 1.0]), triangles([3, 5], [0.3, 0.2])]
    layers = list_layers([ground], bodies, EYE)
    sheer = layers[Layer.SHEER]
    depths = -sheer.vertices[sheer.faces].mean(axis=1)[:, 2]
    np.testing.assert_allclose(depths, [0, 5, 4, 3, 1])
    assert [-layers[Layer.OPEN].vertices[face[0], 2] for face in layers[Layer.OPEN].faces] == [2]
    assert (layers[Layer.OPEN].rgba[:, 3] == 1).all(), "a mesh with any other opacity would be drawn as sheer"
    assert Layer.CLOSED not in layers


def test_solids_are_apart_from_open_meshes_and_all_is_shaded():
    layers = list_layers([], [triangles([1], [1.0], is_open=False), triangles([2], [1.0])], EYE)
    assert set(layers) == {Layer.CLOSED, Layer.OPEN}
    assert all(layer.normals is None for layer in layers.values())
    assert np.abs(layers[Layer.OPEN].rgba[:, :3] - [0.2, 0.4, 0.6]).max() > 0.01
    assert list_layers([], [], EYE) == {}
