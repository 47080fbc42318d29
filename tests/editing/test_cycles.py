"""The cycle of a clip, at any rate and of any length, or that there is none."""

from dataclasses import replace

import pytest
import torch
from helpers import walk

from mapctl import editing, rotations
from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL


def stand(frames: int):
    """A body that stands, and once reaches out."""
    motion = walk(frames)
    local = torch.zeros_like(motion.local_quat_xyzw)
    local[..., 3] = 1
    root = motion.root_position[:1].expand(frames, 3).clone()
    return replace(motion, local_quat_xyzw=local, root_position=root)


@pytest.mark.parametrize("fps", [25, 120])
@pytest.mark.parametrize("cadence", [0.7, 1.4])
def test_a_walk_has_one_stride(fps, cadence):
    motion = walk(4 * fps, cadence=cadence, fps=fps)
    cycle = editing.find_cycle(motion)
    told = editing.describe_cycle(motion, cycle)
    assert cycle.is_gait
    assert told["seconds"] == pytest.approx(1 / cadence, abs=0.6 / fps + 1e-9)
    assert told["steps_per_minute"] == pytest.approx(120 * cadence, rel=0.04)
    travelled = motion.root_position[cycle.stop] - motion.root_position[cycle.start]
    assert told["stride_m"] == pytest.approx(float(travelled[2]), abs=0.01)
    assert told["mismatch_cm"] < 3


def test_standing_before_and_after_is_no_cycle_of_a_walk():
    still = stand(60)
    middle = walk(90, cadence=1.0)
    end = replace(still, root_position=still.root_position + middle.root_position[-1] * torch.tensor([1.0, 0, 1.0]))
    motion = still.join(middle).join(end)
    cycle = editing.find_cycle(motion)
    assert cycle.frames == pytest.approx(30, abs=1)
    assert cycle.start >= 55
    assert cycle.stop <= 155


def test_a_body_on_the_spot_has_a_cycle_that_is_no_gait():
    motion = walk(150, cadence=0.5)
    still = replace(motion, root_position=motion.root_position * torch.tensor([0.0, 1.0, 0.0]).double())
    cycle = editing.find_cycle(still)
    assert not cycle.is_gait
    assert cycle.frames == pytest.approx(60, abs=1)
    assert "stride_m" not in editing.describe_cycle(still, cycle)


def test_what_never_comes_back_is_refused_with_what_comes_nearest():
    frames = 90
    motion = stand(frames)
    local = motion.local_quat_xyzw.clone()
    arm = CANONICAL.index("leftUpperArm")
    reach = torch.linspace(0, 2.5, frames).double()
    local[:, arm] = rotations.from_rotation_vector(torch.stack([0 * reach, 0 * reach, reach], dim=-1))
    shift = torch.linspace(0, 3, frames).double() ** 2
    root = motion.root_position + torch.stack([0 * shift, 0 * shift, shift], dim=-1)
    with pytest.raises(RequestError, match=r"frames \d+ and \d+ come nearest, .* [\d.]+ cm apart; [\d.]+ are allowed"):
        editing.find_cycle(replace(motion, local_quat_xyzw=local, root_position=root))
