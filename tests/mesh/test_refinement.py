"""Finer triangles: they lie in the mesh's, show its picture, are shared at edges, and are not too many."""

import numpy as np
import pytest
from character_maker import make_character_glb
from glb_builder import stripes

from mapctl import formats
from mapctl.mesh.character_mesh import choose_cell, part_triangle, refine

SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def board(corners, shares):
    """Squares of 2 cm, black and white, of a place in SQUARE."""
    at = np.einsum("nc,nck->nk", shares, SQUARE[corners])
    white = (np.floor(at[:, 0] / 0.02 + 1e-6) + np.floor(at[:, 1] / 0.02 + 1e-6)) % 2
    return np.column_stack([np.repeat(white[:, None], 3, axis=1), np.ones(len(at))])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_cells_fill_a_triangle_once_and_face_as_it_does(count):
    points, cells = part_triangle(count)
    assert len(cells) == count**2
    assert np.allclose(points.sum(axis=1), 1)
    corners = points[:, 1:][cells]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    np.testing.assert_allclose(areas, 0.5 / count**2, atol=1e-12)


def test_a_picture_is_shown_to_the_cell_and_edges_are_shared():
    wrong, _ = choose_cell(SQUARE, FACES, board)
    assert wrong.all()
    fine = refine(SQUARE, FACES, wrong, 0.02, board)
    at = fine.spread(SQUARE)
    assert len(np.unique(at.round(6), axis=0)) == len(at), "no point twice"
    np.testing.assert_array_equal(fine.rgba, board(fine.corners, fine.shares))
    np.testing.assert_allclose(fine.shares.sum(axis=1), 1)
    edges = np.sort(np.concatenate([fine.faces[:, [0, 1]], fine.faces[:, [1, 2]], fine.faces[:, [2, 0]]]), axis=1)
    _, met = np.unique(edges, axis=0, return_counts=True)
    assert (met <= 2).all()
    assert (met == 1).sum() == 4 * round((met == 1).sum() / 4), "as many at every side of the outline"


def test_a_character_shows_its_picture_more_sharply_than_its_vertices(tmp_path):
    made = make_character_glb(tmp_path / "hero.glb")
    mesh, shirt = formats.load_mesh(made.path), made.parts[0]
    assert mesh.fine is not None
    of_shirt = (mesh.fine.corners < len(shirt.vertices)).all(axis=1)
    assert (~of_shirt).sum() == len(mesh.vertices) - len(shirt.vertices), "what shows no picture stays"
    corners, shares = mesh.fine.corners[of_shirt], mesh.fine.shares[of_shirt]
    place = np.einsum("nc,nck->nk", shares, shirt.uv[corners])
    row = np.clip((np.mod(place[:, 1], 1) * 64).astype(int), 0, 63)
    true = stripes()[row, 0] / 255
    wrong = np.abs(mesh.fine.rgba[of_shirt, :3] - true).max(axis=1)
    assert np.mean(wrong < 0.02) > 0.95
    assert np.abs(mesh.fine.rgba[:, 3] - 1).max() == 0
    plain = make_character_glb(tmp_path / "plain.glb", picture=np.full((8, 8, 3), 99, np.uint8))
    assert formats.load_mesh(plain.path).fine is None
