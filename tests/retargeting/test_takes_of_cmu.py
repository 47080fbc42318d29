"""ASF/AMC and BVH of one take: the capture on the other's rig travels as far and has the same contacts.

The real takes are no part of the project: with MAPCTL_CMU=FOLDER, which holds `cmu-amc/02_01.amc`,
`cmu/02/02_01.bvh` and so on, they are tried too.
"""

import os
from pathlib import Path

import pytest
from hand_poses import arms_down
from performers import Performer
from rig_maker import Make, make, names_of

from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter, find_ground, retarget_motion

FOLDER = Path(os.environ.get("MAPCTL_CMU", ""))


def travel(motion: Motion) -> float:
    return float(motion.root_position[:, ::2].diff(dim=0).norm(dim=-1).sum())


def spans(motion: Motion, body: RiggedCharacter) -> list[list[tuple[int, int]]]:
    return [*find_ground(body.stance.leveled(motion), body.stance).spans]


def assert_same_contacts(one: list[list[tuple[int, int]]], other: list[list[tuple[int, int]]], first: int = 0) -> None:
    """Within two frames, but where the motion begins."""
    for left, right in zip(one, other, strict=True):
        assert len(left) == len(right)
        for (a, b), (c, d) in zip(left, right, strict=True):
            assert max(a, first) == pytest.approx(max(c, first), abs=2)
            assert b == pytest.approx(d, abs=2)


@pytest.mark.parametrize("fps", [30, 120])
def test_a_walk_named_as_in_asf_on_a_rig_named_as_in_bvh(fps):
    walk = arms_down(Performer().walks(3 * fps, fps))
    capture = make(Make(names_of("cmu-asf"), bones_along_x=True, extras=False)).motion(walk)
    rig = make(Make(names_of("cmu-daz"), size=0.96, extras=False)).motion(Performer(size=0.96).walks())
    body = RiggedCharacter.of(rig)[1]
    found = retarget_motion(capture, body)
    own, giver = RiggedCharacter.of(capture)
    assert travel(found.motion) == pytest.approx(found.changes.scale * travel(own), rel=0.01)
    assert found.changes.travel_ratio == pytest.approx(found.changes.scale, rel=0.01)
    assert_same_contacts(spans(own, giver), spans(found.motion, body))
    assert sum(map(len, spans(own, giver))) >= 4
