"""Ground that is not flat: heights by an independent formula, and refusals of one line."""

import math

import numpy as np
import pytest
import torch

from mapctl.errors import FileFormatError
from mapctl.ground import Ground

PARTS = """
[[ramps]]
start = [1.0, 1.0]
end = [1.0, 3.0]
heights = [0.1, 0.5]
width = 1.0

[[boxes]]
centre = [-3.0, 0.0]
size = [2.0, 1.0]
height = 0.15
heading_deg = 90.0

[[stairs]]
start = [4.0, 0.0]
steps = 3
rise = 0.2
tread = 0.3
width = 1.0
heading_deg = 90.0
base = 0.1
"""


def write(folder, text):
    path = folder / "ground.toml"
    path.write_text(text)
    return path


def height_of_parts(x, z):
    """By hand: the ramp goes along +Z, the box is turned so that it is 1 m along x, stairs rise along +X."""
    if 0.5 <= x <= 1.5 and 1 <= z <= 3:
        return 0.1 + 0.2 * (z - 1)
    if -3.5 <= x <= -2.5 and abs(z) <= 1:
        return 0.15
    if 4 <= x <= 4.9 and abs(z) <= 0.5:
        return 0.1 + 0.2 * (1 + math.floor((x - 4) / 0.3))
    return 0.0


def test_heights_are_those_of_the_highest_part(tmp_path):
    ground = Ground.read(write(tmp_path, PARTS))
    points = np.random.default_rng(0).uniform([-5, -3], [6, 4], (4000, 2))
    found = ground.height(torch.from_numpy(points))
    wanted = torch.tensor([height_of_parts(x, z) for x, z in points], dtype=torch.float64)
    assert float(wanted.max()) > 0.6
    torch.testing.assert_close(found, wanted, atol=1e-9, rtol=0)


def test_a_grey_picture_is_a_height_field_along_x_and_z(tmp_path):
    image = pytest.importorskip("PIL.Image")
    grey = np.tile(np.arange(0, 256, 5, dtype=np.uint8), (20, 1))  # rises along +X
    grey[10:] = 255  # and is white where z is positive
    image.fromarray(grey).save(tmp_path / "hill.png")
    text = '[image]\nfile = "hill.png"\nsize = [5.2, 2.0]\nwhite = 1.0\ncentre = [1.0, 0.0]'
    ground = Ground.read(write(tmp_path, text))
    at = torch.tensor([[-1.0, -0.5], [1.0, -0.5], [3.0, -0.5], [0.0, 0.5], [9.0, 0.0]], dtype=torch.float64)
    wanted = [((x + 1.6) / 0.1 - 0.5) * 5 / 255 for x in (-1.0, 1.0, 3.0)]
    assert ground.height(at).tolist() == pytest.approx([*wanted, 1.0, 0.0], abs=1e-6)


REFUSED = {
    "unknown key": (
        "[[boxes]]\ncentre = [0, 0]\nsize = [1, 1]\nheight = 1\nhigh = 1",
        "boxes[0].high: there is no such key; the nearest is height; allowed",
    ),
    "negative size": ("[[boxes]]\ncentre = [0, 0]\nsize = [1, -1]\nheight = 1", "boxes[0].size[1]: "),
    "ramp without length": ("[[ramps]]\nstart = [0, 1]\nend = [0, 1]\nheights = [0, 1]", "ramps[0].end: a ramp is"),
    "missing key": ("[[stairs]]\nstart = [0, 1]\nsteps = 3\nrise = 0.2", "stairs[0].tread: this key is needed"),
    "nothing": ("boxes = []", "holds no ground"),
    "no picture": ('[image]\nfile = "none.png"\nsize = [1, 1]\nwhite = 1', "is not a picture"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_faults_are_named_in_one_line(case, tmp_path):
    text, expected = REFUSED[case]
    with pytest.raises(FileFormatError) as error:
        Ground.read(write(tmp_path, text))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
