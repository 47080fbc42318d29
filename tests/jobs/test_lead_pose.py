"""A T-pose before the motion, and frames that software has mixed it into: every frame is as clean as the others."""

import math
from dataclasses import replace

import pytest
import torch
from captures import noisy, on_rig, shaken
from tiny_denoiser import QUICK, tiny_denoiser

from controllers.denoising.denoise import begins_with_tpose, denoise
from controllers.denoising.lead_pose import find_lead_transition
from mapctl import retarget, rotations
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

SHARES = (0.26, 0.53, 0.78, 0.95)
"""Of the motion in the first frames of CMU's takes, as the filter of an exporter left them."""


def tpose(motion: Motion, *, turned: float = 0.6) -> Motion:
    """The T-pose of a motion's rig, as a motion of one frame, facing another way than the motion."""
    canonical, rigmap = retarget.to_canonical(motion)
    quats = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, CANONICAL.num_joints, 4).clone()
    quats[:, 0] = rotations.about_y(torch.tensor([turned], dtype=torch.float64))
    first = replace(canonical.slice(0, 1), local_quat_xyzw=quats)
    return replace(retarget.from_canonical(first, rigmap), source=motion.source)


def led(motion: Motion, shares=SHARES) -> Motion:
    """The motion behind its T-pose, which is mixed into its first frames but not into where the body is and faces."""
    pose = tpose(motion)
    quats = motion.local_quat_xyzw.clone()
    for frame, share in enumerate(shares):
        weight = torch.full((motion.num_joints,), share, dtype=torch.float64)
        quats[frame] = rotations.slerp(pose.local_quat_xyzw[0], quats[frame], weight)
    body = retarget.identify_rig(motion.skeleton).joint_of[0]
    quats[:, : body + 1] = motion.local_quat_xyzw[:, : body + 1]
    moving = {joint: values[:1] for joint, values in motion.moving_offsets.items()}
    pose = replace(pose, moving_offsets=moving, root_position=motion.root_position[:1])
    return pose.join(replace(motion, local_quat_xyzw=quats))


def errors_cm(truth: Motion, other: Motion) -> torch.Tensor:
    return 100 * (truth.joint_positions() - other.joint_positions()).norm(dim=-1).mean(dim=-1)


def arms_down(motion: Motion) -> Motion:
    """As people walk: by 70 degrees and more from the T-pose."""
    canonical, rigmap = retarget.to_canonical(motion)
    quats = canonical.local_quat_xyzw.clone()
    for name, sign in (("leftUpperArm", -1.0), ("rightUpperArm", 1.0)):
        down = rotations.from_rotation_vector(torch.tensor([0.0, 0.0, sign * 1.25], dtype=torch.float64))
        quats[:, CANONICAL.index(name)] = rotations.multiply(
            quats[:, CANONICAL.index(name)], down.expand(len(quats), 4)
        )
    return retarget.from_canonical(replace(canonical, local_quat_xyzw=quats), rigmap, motion)


def cleaned(motion: Motion, **changes):
    return denoise(motion, tiny_denoiser(), **{"settings": QUICK} | changes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("rig", "fps"), [("daz", 120), ("canonical", 60)])
def test_no_frame_after_a_mixed_in_tpose_errs_by_far_more_than_the_others(rig, fps, seed):
    truth = led(arms_down(on_rig(rig, 2 * fps, fps=fps, seed=seed)))
    given = noisy(truth, 5.0, 1.0, seed=seed)
    done = cleaned(given)
    away = errors_cm(truth, done.motion)
    # The tests' network only smooths, which the ends of a capture suffer from; a pose that is mixed in costs 20 cm.
    assert away[1:8].max() < 7
    assert away.mean() < 0.6 * errors_cm(truth, given).mean()
    told = [note for note in done.notes if "mix it into the motion" in note]
    assert told
    assert not [fault for fault in done.faults if fault.kind == "dropout" and fault.start < 8]


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["bandai", "daz", "canonical"])
def test_without_a_mixture_the_first_frames_are_motion(rig):
    truth = led(arms_down(on_rig(rig, 90)), shares=())
    given = noisy(truth, 5.0, 1.0, seed=4)
    assert find_lead_transition(given, retarget.identify_rig(given.skeleton)).stop <= 2  # noise may look like a trace
    done = cleaned(given)
    away = errors_cm(truth, done.motion)
    assert away[1:8].max() < 9


def test_where_the_body_is_may_be_mixed_too():
    truth = arms_down(on_rig("canonical", 120, fps=120))
    pose = tpose(truth)
    pose = replace(pose, root_position=truth.root_position[:1] + torch.tensor([[1.5, 0.0, -1.0]], dtype=torch.float64))
    quats, place = truth.local_quat_xyzw.clone(), truth.root_position.clone()
    for frame, share in enumerate(SHARES):
        weight = torch.full((truth.num_joints,), share, dtype=torch.float64)
        quats[frame] = rotations.slerp(pose.local_quat_xyzw[0], quats[frame], weight)
        place[frame] = torch.lerp(pose.root_position[0], place[frame], share)
    truth = pose.join(replace(truth, local_quat_xyzw=quats, root_position=place))
    given = noisy(truth, 3.0, 1.0, seed=1)
    found = find_lead_transition(given, retarget.identify_rig(given.skeleton))
    assert found.position
    assert bool(found.joints[0])
    away = errors_cm(truth, cleaned(given).motion)
    assert away[1:6].max() < 12  # of 1.8 m between the two places


def test_where_the_body_is_is_not_taken_for_mixed_because_of_noise():
    """The pose is a few centimetres from where the motion begins, as in most takes, and noise is 2 cm."""
    truth = led(arms_down(on_rig("canonical", 120, fps=120)))
    place = truth.root_position.clone()
    place[0] += torch.tensor([0.01, 0.03, 0.07], dtype=torch.float64)
    truth = replace(truth, root_position=place)
    rigmap = retarget.identify_rig(truth.skeleton)
    found = [find_lead_transition(noisy(truth, 5.0, 2.0, seed=seed), rigmap).position for seed in range(30)]
    assert sum(found) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rest", ["straighten", "auto"])
def test_a_tpose_is_told_under_noise_whatever_rest_the_rig_has(rest, seed):
    """Also where the rig's own T-pose is found from the motion, noise and all."""
    truth = led(arms_down(on_rig("daz", 90)), shares=())
    given = noisy(truth, 6.0, 1.0, seed=seed)
    rig = Rig("own", retarget.identify_rig(truth.skeleton).rig.joints) if rest == "auto" else None
    assert begins_with_tpose(given, rig)
    assert not begins_with_tpose(given.slice(1, 91), rig)
    moved = errors_cm(given.slice(0, 1), cleaned(given, rig=rig).motion.slice(0, 1))
    assert moved.max() < 25


def test_a_motion_that_begins_with_arms_out_begins_with_no_tpose():
    """A dancer's arms may be out in frame 0: nothing leaps."""
    motion = on_rig("canonical", 90)
    quats = motion.local_quat_xyzw.clone()
    down = torch.linspace(0.05, 1.2, 90, dtype=torch.float64)
    for name, sign in (("leftUpperArm", -1.0), ("rightUpperArm", 1.0)):
        vector = torch.zeros(90, 3, dtype=torch.float64)
        vector[:, 2] = sign * down
        quats[:, CANONICAL.index(name)] = rotations.from_rotation_vector(vector)
    motion = replace(motion, local_quat_xyzw=shaken(quats, math.radians(6.0)))
    assert not begins_with_tpose(motion)
