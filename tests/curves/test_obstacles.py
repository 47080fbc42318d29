"""Discs and boxes on the ground: how far points are from them, against sampled outlines."""

import pytest
import torch
from helpers import generator

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError

SHAPES = {
    "disc": Obstacle((0.4, -1.2), 0.7),
    "box": Obstacle((-0.3, 0.8), size=(1.4, 0.6)),
    "turned box": Obstacle((0.2, 0.1), size=(1.4, 0.6), turn_deg=35),
}


@pytest.mark.parametrize("obstacle", SHAPES.values(), ids=SHAPES)
def test_distance_is_that_to_the_nearest_point_of_the_outline_and_negative_within(obstacle):
    corners = obstacle.outline()
    ends = corners.roll(-1, 0)
    share = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None, None]
    edge = (corners + share * (ends - corners)).flatten(0, 1)
    points = 4 * torch.rand(300, 2, generator=generator(1)).double() - 2
    nearest = torch.cdist(points, edge).amin(1)
    found = obstacle.distance(points)
    torch.testing.assert_close(found.abs(), nearest, atol=0.004, rtol=0)
    centre = torch.tensor([obstacle.place], dtype=torch.float64)
    assert float(obstacle.distance(centre)) < 0
    inside = found < 0
    towards = obstacle.distance(points + 0.3 * (centre - points))
    assert bool((towards[inside] < 0).all())  # all of them are convex


def test_a_positive_turn_turns_z_toward_x():
    box = Obstacle((0.0, 0.0), size=(0.2, 2.0), turn_deg=90)  # long along +Z before, along +X after
    assert float(box.distance(torch.tensor([0.9, 0.0]))) < 0 < float(box.distance(torch.tensor([0.0, 0.9])))
    slanted = Obstacle((0.0, 0.0), size=(0.2, 2.0), turn_deg=45)
    assert float(slanted.distance(torch.tensor([0.6, 0.6]))) < 0 < float(slanted.distance(torch.tensor([-0.6, 0.6])))


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "1,2,3,4", "0,0,0", "0,0,-1", "0,0,nan"])
def test_what_is_no_disc_is_refused(text):
    with pytest.raises(RequestError):
        Obstacle.parse(text)
