"""What a capture lacks for a while is an in-betweener's, all else the denoiser's."""

from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import walk
from tiny_denoiser import QUICK, tiny_denoiser

from controllers.denoising.denoise import LostPartFiller, denoise
from mapctl.inbetweening import Proposal
from mapctl.protocols import Inbetweener
from mapctl.recording import Capture
from mapctl.recording.masks import Mask
from mapctl.skeleton import CANONICAL

ARM = [CANONICAL.index(name) for name in ("leftUpperArm", "leftLowerArm", "leftHand")]


class Marking(Inbetweener):
    """Turns everything half round and lifts it by a metre, so that all that it proposes is seen."""

    def __init__(self):
        self.queries = []

    def propose(self, query, *, generator=None):
        self.queries.append(query)
        quats = torch.zeros_like(query.motion.local_quat_xyzw)
        quats[..., 0] = 1.0
        lifted = query.motion.root_position + torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        made = replace(query.motion, root_position=lifted, local_quat_xyzw=quats)
        return Proposal(made, torch.zeros(made.num_frames, 2), "marking")


def capture_of(motion, *, joints=(), start=0, stop=0, root=False):
    seen = torch.ones(motion.num_frames, motion.num_joints, dtype=torch.bool)
    seen[start:stop, list(joints)] = False
    seen_root = torch.ones(motion.num_frames, dtype=torch.bool)
    if root:
        seen_root[start:stop] = False
    sigma = torch.full((motion.num_joints,), 0.02)
    return Capture.of_motion(motion, seen=seen, seen_root=seen_root, sigma=sigma, sigma_root=0.005)


@pytest.mark.parametrize("root", [False, True])
def test_only_what_is_lost_for_long_is_the_in_betweener_s(root):
    capture, marking = capture_of(walk(60), joints=ARM, start=20, stop=40, root=root), Marking()
    plain = tiny_denoiser().clean(capture)
    found = LostPartFiller(tiny_denoiser(), marking).clean(capture)
    before, after = (each.pose.local_quat_xyzw[0] for each in (plain, found))
    lost = torch.zeros(60, CANONICAL.num_joints, dtype=torch.bool)
    lost[20:40, ARM] = True
    same = (before * after).sum(dim=-1).abs()
    assert same[~lost].min() > 1 - 1e-5
    assert after[lost][:, 0].abs().min() > 1 - 1e-5
    risen = (found.pose.root_position - plain.pose.root_position)[0, :, 1]
    assert torch.allclose(risen[20:40], torch.full((20,), float(root)), atol=1e-5)
    assert risen[:20].abs().max() < 1e-5
    (query,) = marking.queries
    assert torch.equal(query.missing.joints, lost)
    assert bool(query.missing.root.any()) == root


def test_what_is_lost_for_a_moment_or_whole_stays_the_denoiser_s():
    marking = Marking()
    filler = LostPartFiller(tiny_denoiser(), marking)
    for capture in (
        capture_of(walk(60), joints=ARM, start=20, stop=27),
        capture_of(walk(60)),
        capture_of(walk(60), joints=range(CANONICAL.num_joints), start=0, stop=60),
    ):
        found, plain = filler.clean(capture), tiny_denoiser().clean(capture)
        assert torch.equal(found.pose.pack(), plain.pose.pack())
    assert marking.queries == []


@pytest.mark.parametrize(("rig", "fps"), [("daz", 60), ("bandai", 25)])
def test_denoising_takes_it_on_any_rig_and_at_any_rate(rig, fps):
    motion = on_rig(rig, 3 * fps, fps=fps)
    arm = motion.skeleton.names[
        next(j for j, name in enumerate(motion.skeleton.names) if "ForeArm" in name or "LowerArm" in name)
    ]
    masks = [Mask(arm, fps, 2 * fps)]
    joint = motion.skeleton.names.index(arm)
    marked, plain = (
        denoise(motion, tiny_denoiser(), inbetweener=each, masks=masks, settings=QUICK).motion
        for each in (Marking(), None)
    )
    apart = 1 - (marked.local_quat_xyzw * plain.local_quat_xyzw).sum(dim=-1).abs()
    assert apart[fps + fps // 6 : 2 * fps - fps // 6, joint].min() > 0.01
    assert apart[: fps - fps // 3].max() < 0.01
