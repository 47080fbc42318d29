"""Denoising from one end to the other, with a network that is untrained or made of drawn weights."""

import json
import math
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from captures import apart_deg, error_cm, noisy, on_rig, shaken
from helpers import generator, walk
from performers import Performer
from tiny_denoiser import QUICK, tiny_denoiser

from controllers.denoising.causal import denoise_causal
from controllers.denoising.denoise import LostPartFiller, denoise
from controllers.denoising.solution import join_segments
from controllers.denoising.trajectory import correct_trajectory
from mapctl import retarget, rotations
from mapctl.editing import remove_travel
from mapctl.inbetweening import Proposal
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording import Capture
from mapctl.recording.inspection import estimate_lead_shares, hold_rigid_bones
from mapctl.recording.masks import ALL, Mask, MissingMask, restore_observed
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES

RIGS = ("canonical", "bandai", "daz")


def cleaned(motion, **changes):
    return denoise(motion, tiny_denoiser(), **{"settings": QUICK} | changes)


@pytest.mark.parametrize(("rig", "fps"), [("canonical", 30), ("bandai", 24), ("daz", 120)])
def test_noise_shrinks_and_rig_frames_and_rate_stay(rig, fps):
    truth = on_rig(rig, 3 * fps, fps=fps)
    given = noisy(truth)
    done = cleaned(given)
    assert done.capture is given or done.capture.num_frames == given.num_frames
    assert done.motion.skeleton is given.skeleton
    assert (done.motion.num_frames, done.motion.fps) == (given.num_frames, given.fps)
    assert set(done.motion.moving_offsets) == set(given.moving_offsets)
    assert error_cm(truth, done.motion) < 0.75 * error_cm(truth, given)
    assert torch.allclose(done.motion.local_quat_xyzw.norm(dim=-1), torch.ones(1, dtype=torch.float64))
    assert torch.equal(done.motion.root_position, given.root_position) == (rig == "bandai")
    assert abs(len(done.contacts) - 90) <= 4
    assert len(done.proposal_share) == len(done.contacts)


@pytest.mark.parametrize(("rig", "fps"), [("bandai", 30), ("daz", 60)])
def test_a_clean_capture_changes_by_less_than_half_a_centimetre(rig, fps):
    truth = on_rig(rig, 2 * fps, fps=fps)
    done = denoise(truth, tiny_denoiser(drawn=0.3), settings=QUICK)
    assert error_cm(truth, done.motion) < 0.5
    assert roughness(done.motion) <= roughness(truth)


def roughness(motion):
    """Mean third difference of joints, metres."""
    return float(motion.joint_positions().diff(n=3, dim=0).norm(dim=-1).mean())


@pytest.mark.parametrize("fps", [24, pytest.param(240, marks=pytest.mark.slow)])
def test_any_rate_is_as_good_as_the_priors_own(fps):
    """Errors and toes' acceleration beside those of the same motion with as much noise a second at 30 fps."""

    def measure(rate):
        truth = on_rig("daz", round(4 * rate), fps=rate)
        done = cleaned(noisy(truth, 5.0 * (rate / 30) ** 0.5))
        toes = done.motion.joint_positions()[:, [truth.skeleton.index(name) for name in ("lFoot", "rFoot")]]
        return error_cm(truth, done.motion), float(toes.diff(n=2, dim=0).norm(dim=-1).mean()) * rate**2

    (error, acceleration), (usual_error, usual_acceleration) = measure(fps), measure(30)
    assert error < 1.15 * usual_error
    assert acceleration < 1.5 * usual_acceleration


STRETCH = {
    "noise": (lambda track: track + 0.01 * torch.randn(track.shape, generator=generator()).double(), True),
    "a frame of zeros": (lambda track: track.index_fill(0, torch.tensor([40]), 0.0), True),
    "lost for long": (lambda track: track.index_fill(0, torch.arange(30, 60), 0.0), True),
    "slow": (lambda track: track * (1 + 0.1 * torch.linspace(0, 6, len(track)).sin()[:, None]), False),
    "slow under noise": (
        lambda track: (
            track * (1 + 0.1 * torch.linspace(0, 6, len(track)).sin()[:, None])
            + 0.01 * torch.randn(track.shape, generator=generator()).double()
        ),
        False,
    ),
    "squashed for four frames": (lambda track: track.index_copy(0, torch.arange(4) + 40, 0.7 * track[:4]), False),
}


@pytest.mark.parametrize("kind", STRETCH)
def test_offsets_that_vary_only_by_noise_are_held_and_stretching_ones_stay(kind):
    change, rigid = STRETCH[kind]
    truth = on_rig("bandai", 120)
    joint = truth.skeleton.index("LowerLeg_L")
    still = truth.skeleton.offsets[joint].expand(120, 3).clone()
    given = replace(truth, moving_offsets={**truth.moving_offsets, joint: change(still)})
    held, faults = hold_rigid_bones(given)
    assert [fault.joint for fault in faults] == ["LowerLeg_L"] * rigid
    track = held.moving_offsets[joint]
    if rigid:
        torch.testing.assert_close(track, still, atol=0.004, rtol=0)
        assert bool((track == track[0]).all())
    else:
        assert torch.equal(track, given.moving_offsets[joint])
    assert torch.equal(held.moving_offsets[1], given.moving_offsets[1])  # the hips travel


def test_a_network_that_is_wrong_does_little_harm():
    """Channels that the proposal leaves out of the capture are restored."""
    truth = on_rig("bandai", 150)
    given = noisy(truth, 6.0)
    done = denoise(given, tiny_denoiser(drawn=0.5), settings=QUICK)
    assert error_cm(truth, done.motion) < 1.1 * error_cm(truth, given)
    assert done.proposal_share.mean() < 0.9


def test_the_density_joins_where_one_is_given():
    from helpers import tiny_density

    given = noisy(on_rig("canonical", 40))
    done = cleaned(given, densities=[tiny_density()])
    assert "likelihood" in {entry.name for entry in done.ledger.entries}
    assert done.motion.num_frames == 40


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
def test_what_masked_frames_show_does_not_leak(rig):
    truth = on_rig(rig, 120)
    given, rigmap = noisy(truth, 2.0, 0.5), retarget.identify_rig(truth.skeleton)
    joint = rigmap.joint_of[CANONICAL.index("leftLowerArm")]
    masks, out = [Mask(truth.skeleton.names[joint], 50, 58)], []
    for seed in (1, 2):
        quats = given.local_quat_xyzw.clone()
        quats[50:58, joint] = shaken(given.local_quat_xyzw, 2.0, seed=seed)[50:58, joint]
        out.append(cleaned(replace(given, local_quat_xyzw=quats), masks=masks).motion)
    assert apart_deg(out[0].local_quat_xyzw, out[1].local_quat_xyzw).max() < 1e-3
    assert error_cm(truth, out[0]) < 3
    assert apart_deg(out[0].local_quat_xyzw, truth.local_quat_xyzw)[50:58, joint].max() < 20


@pytest.mark.parametrize("rig", RIGS)
def test_frames_in_which_everything_is_masked_are_filled_in(rig):
    truth = on_rig(rig, 120)
    given = noisy(truth, 2.0, 0.5)
    lost = torch.zeros(120, dtype=torch.bool)
    lost[60:66] = True
    moving = {joint: values + 5 for joint, values in given.moving_offsets.items()}
    root, quats = given.root_position + 5 * (not moving), shaken(given.local_quat_xyzw, 2.0, seed=3)
    wild = replace(given, local_quat_xyzw=quats, root_position=root, moving_offsets=moving)
    wild = restore_observed(wild, given, MissingMask.of_frames(lost, given.num_joints))
    assert error_cm(truth, wild) > 10
    done = cleaned(wild, masks=[Mask(ALL, 60, 66)])
    positions = (done.motion.joint_positions() - truth.joint_positions()).norm(dim=-1).mean(dim=-1)
    assert positions[60:66].max() < 0.15
    assert {fault.kind for fault in done.faults if fault.start == 60} >= {"dropout"}


def test_planted_faults_are_listed_where_they_are():
    truth = on_rig("daz", 120)
    given = noisy(truth, 2.0, 1.0)
    arm, hand = (truth.skeleton.index(name) for name in ("lForeArm", "rHand"))
    quats = given.local_quat_xyzw.clone()
    leap = torch.tensor([0.0, math.sin(0.5), 0.0, math.cos(0.5)], dtype=torch.float64)  # 57 degrees
    quats[40, arm] = rotations.multiply(quats[40, arm], leap)
    quats[70:84, hand] = quats[70, hand]
    root = given.root_position.clone()
    root[90, 1] += 0.8
    done = cleaned(replace(given, local_quat_xyzw=quats, root_position=root))
    spikes = [(f.joint, f.start, f.stop) for f in done.faults if f.kind == "spike" and f.unit == "deg"]
    assert ("lForeArm", 40, 41) in spikes
    assert len(spikes) < 20
    (height,) = [f.amount for f in done.faults if f.kind == "spike" and f.joint == "lForeArm" and f.start == 40]
    assert height == pytest.approx(57, abs=12)
    assert ("hip", 90, 91) in [(f.joint, f.start, f.stop) for f in done.faults if f.unit == "cm" and f.kind == "spike"]
    assert ("rHand", 71, 84) in [(f.joint, f.start, f.stop) for f in done.faults if f.kind == "dropout"]
    noise = {f.joint: f.amount for f in done.faults if f.kind == "noise" and f.unit == "deg"}
    assert noise["lForeArm"] == pytest.approx(2, rel=0.4)
    assert (done.motion.root_position - truth.root_position).norm(dim=-1)[88:93].max() < 0.15
    assert apart_deg(done.motion.local_quat_xyzw, truth.local_quat_xyzw)[40, arm] < 12


LEGS = [[f"{part}_{side}" for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")] for side in "LR"]


def test_legs_of_a_capture_that_are_swapped_are_exchanged_back():
    truth = on_rig("bandai", 90)
    legs = [[j for j, name in enumerate(truth.skeleton.names) if name in wanted] for wanted in LEGS]
    quats = truth.local_quat_xyzw.clone()
    quats[40:42, legs[0] + legs[1]] = quats[40:42, legs[1] + legs[0]]
    given = replace(truth, local_quat_xyzw=quats)
    done = cleaned(given)
    assert torch.equal(done.capture.local_quat_xyzw, quats)
    assert [(f.start, f.stop) for f in done.faults if f.kind == "swap"] == [(40, 42)]
    assert any("exchanged back" in note for note in done.notes)
    apart = (done.motion.joint_positions() - truth.joint_positions()).norm(dim=-1)[38:44]
    assert apart.max() < 0.05 < 0.2 < (given.joint_positions() - truth.joint_positions()).norm(dim=-1).max()


ARMS_DOWN = (("leftUpperArm", -1.25), ("rightUpperArm", 1.25))


def lead(rig, fps, shares):
    """A walk with its arms down behind its T-pose, which is blended into its first frames by these shares."""
    canonical, rigmap = retarget.to_canonical(on_rig(rig, 2 * fps, fps=fps))
    quats = canonical.local_quat_xyzw.clone()
    for name, angle in ARMS_DOWN:
        turn = rotations.from_rotation_vector(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
        quats[:, CANONICAL.index(name)] = rotations.multiply(quats[:, CANONICAL.index(name)], turn.expand(2 * fps, 4))
    quats[0, 1:] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    for frame, share in enumerate(shares, start=1):
        weight = torch.full((CANONICAL.num_joints,), share, dtype=torch.float64)
        quats[frame] = rotations.slerp(quats[0], quats[frame], weight)
    return retarget.from_canonical(replace(canonical, local_quat_xyzw=quats), rigmap)


@pytest.mark.parametrize(
    ("rig", "fps", "shares"),
    [("canonical", 30, ()), ("bandai", 60, (0.26, 0.53, 0.78)), ("daz", 60, ()), ("daz", 30, (0.26, 0.53, 0.78))],
)
def test_a_tpose_and_the_frames_blended_with_it_stay_but_for_noise(rig, fps, shares):
    truth = lead(rig, fps, shares)
    given, first = noisy(truth, 3.0, 1.0), 1 + len(shares)
    done = cleaned(given)
    before, after = (apart_deg(m.local_quat_xyzw, truth.local_quat_xyzw)[:first].mean() for m in (given, done.motion))
    assert after < 0.5 * before
    assert apart_deg(cleaned(truth).motion.local_quat_xyzw, truth.local_quat_xyzw)[:first].max() < 0.5
    assert done.motion.num_frames == done.capture.num_frames == 2 * fps
    assert not torch.equal(done.motion.local_quat_xyzw[first], given.local_quat_xyzw[first])
    rest = slice(first, 2 * fps)
    assert error_cm(truth.slice(first, 2 * fps), done.motion.slice(rest.start, rest.stop)) < 0.8 * error_cm(
        truth.slice(first, 2 * fps), given.slice(first, 2 * fps)
    )
    assert next((f.start, f.stop) for f in done.faults if f.kind == "noise") == (first, 2 * fps)
    assert "T-pose" in done.notes[0]
    assert abs(len(done.contacts) - 60) <= 4


def test_a_motion_that_begins_with_arms_out_has_no_lead_pose():
    """A dancer's arms may be out in frame 0: nothing leaps."""
    motion = on_rig("canonical", 90)
    quats = motion.local_quat_xyzw.clone()
    down = torch.linspace(0.05, 1.2, 90, dtype=torch.float64)
    for name, angle in ARMS_DOWN:
        vector = torch.zeros(90, 3, dtype=torch.float64)
        vector[:, 2] = math.copysign(1.0, angle) * down
        quats[:, CANONICAL.index(name)] = rotations.from_rotation_vector(vector)
    assert not len(estimate_lead_shares(replace(motion, local_quat_xyzw=shaken(quats, math.radians(6.0)))))


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "fps"), [("bandai", 30), ("daz", 60)])
def test_a_long_capture_in_pieces_has_all_frames_and_no_jump(monkeypatch, rig, fps):
    module = import_module("controllers.denoising.denoise")  # the package has a function of this name
    monkeypatch.setattr(module, "_SEGMENT_SECONDS", 2.0)
    monkeypatch.setattr(module, "_OVERLAP_SECONDS", 0.5)
    truth, calls = on_rig(rig, 7 * fps, fps=fps), []
    given = noisy(truth)
    done = cleaned(given, progress=lambda now, of: calls.append((now, of)), masks=[Mask(ALL, 3 * fps, 3 * fps + 2)])
    assert done.motion.num_frames == 7 * fps
    assert len(calls) >= 4
    assert calls[-1] == (7 * fps, 7 * fps)
    assert len(done.contacts) == len(done.proposal_share) == 210
    assert all(len(entry.energy) == 210 for entry in done.ledger.entries)
    assert error_cm(truth, done.motion) < 0.8 * error_cm(truth, given)
    leap = torch.diff(done.motion.joint_positions(), n=2, dim=0).norm(dim=-1).amax(dim=-1)
    within = leap[fps // 6 :]
    assert within.max() < 3 * within.quantile(0.9)
    lost = [fault for fault in done.faults if fault.kind == "dropout"]
    assert {(fault.start, fault.stop) for fault in lost} == {(3 * fps, 3 * fps + 2)}
    noise = {(fault.start, fault.stop) for fault in done.faults if fault.kind == "noise"}
    assert noise == {(0, 7 * fps)}
    json.dumps(done.details(), allow_nan=False)


@pytest.mark.parametrize("frames", [1, 7])
def test_too_short_a_capture_is_unchanged_with_a_note(frames):
    given = noisy(on_rig("bandai", 30)).slice(0, frames)
    done = cleaned(given)
    assert torch.equal(done.motion.local_quat_xyzw, given.local_quat_xyzw)
    assert "nothing was changed" in " ".join(done.notes)


def test_a_part_of_a_result_is_of_those_frames():
    done = cleaned(noisy(on_rig("daz", 120, fps=60)))
    first, second = done.slice(0, 50), done.slice(50, 120)
    assert (first.motion.num_frames, len(first.contacts)) == (50, 25)
    assert all(0 <= fault.start < fault.stop <= 70 for fault in second.faults)
    whole = join_segments([(first, 0), (second, 50)])
    assert torch.equal(whole.motion.local_quat_xyzw, done.motion.local_quat_xyzw)
    assert set(whole.faults) == set(done.faults)
    assert torch.equal(whole.contacts, done.contacts)
    assert torch.equal(whole.proposal_share, done.proposal_share)


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
        result = replace(query.motion, root_position=lifted, local_quat_xyzw=quats)
        return Proposal(result, torch.zeros(result.num_frames, 2), "marking")


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


def wobbling(motion: Motion) -> Motion:
    """A motion at 30 frames a second that drifts and floats as an estimate from video."""
    seconds = torch.arange(motion.num_frames, dtype=torch.float64) / 30
    wobble = torch.stack([torch.sin(4 * seconds), torch.sin(2 * seconds), torch.sin(5 * seconds + 1)], dim=-1)
    moved = torch.tensor([0.03, 0.05, 0.05]) * wobble + torch.tensor([0.0, -0.4, 0.0])
    return replace(motion, root_position=motion.root_position + moved)


def test_a_body_that_drifts_and_floats_is_put_on_the_floor_by_its_feet():
    """Estimates from video drift; a capture without drift hardly changes."""
    walk = Performer().walks(240)
    drifting, toes = wobbling(walk), walk.skeleton.indices(TOES)

    def measure(motion: Motion) -> tuple[float, float, float]:
        """Error over the ground and in height, metres, and speed of the lower toe, m/s."""
        away = motion.root_position - walk.root_position
        away = away - away.mean(dim=0)
        feet = motion.joint_positions()[:, toes]
        speed = 30 * feet[..., ::2].diff(dim=0).norm(dim=-1)
        lower = speed[torch.arange(239), feet[1:, :, 1].argmin(dim=1)]
        return float(away[:, ::2].norm(dim=-1).mean()), float(away[:, 1].abs().mean()), float(lower.median())

    corrected, unchanged, in_place = map(correct_trajectory, (drifting, walk, remove_travel(walk)))
    before, after, studio = map(measure, (drifting, corrected.motion, unchanged.motion))
    assert after[0] < 0.5 * before[0]
    assert after[1] < 0.5 * before[1]
    assert before[2] > 0.1
    assert after[2] < 0.4 * before[2]
    assert max(studio[:2]) < 0.005
    assert corrected.from_video
    assert not unchanged.from_video
    assert not in_place.from_video
    lower = corrected.motion.joint_positions()[:, toes, 1].amin(dim=1)
    assert TOE_REST_HEIGHT - 0.01 < float(lower.median()) < TOE_REST_HEIGHT + 0.04


def test_an_estimate_from_video_is_noticed_and_its_tremor_removed():
    """Tremor below 8 Hz is no noise to a studio's camera; white noise is no tremor."""
    walk, draw = Performer().walks(240), generator(1)
    slow = torch.randn(122, walk.num_joints * 3, generator=draw, dtype=torch.float64)
    tremor = torch.nn.functional.interpolate(slow.T[None], size=240, mode="linear")[0].T.unflatten(-1, (-1, 3))
    turned = rotations.from_rotation_vector(0.03 * tremor)
    video = wobbling(replace(walk, local_quat_xyzw=rotations.multiply(walk.local_quat_xyzw, turned)))

    def measure(motion: Motion) -> tuple[float, float]:
        """Error about the hips, metres, and mean third difference."""
        about = [each.joint_positions() - each.root_position[:, None] for each in (motion, walk)]
        return float((about[0] - about[1]).norm(dim=-1).mean()), float(about[0].diff(n=3, dim=0).norm(dim=-1).mean())

    done = denoise(video, tiny_denoiser(), settings=QUICK)
    assert done.drift is not None
    assert "as in estimates from video" in done.notes[0]
    (before, rough), (after, smooth) = measure(video), measure(done.motion)
    assert after < 0.8 * before
    assert smooth < 0.3 * rough
    for capture in (walk, noisy(walk, degrees=1.0, centimetres=0.3)):
        assert denoise(capture, tiny_denoiser(), settings=QUICK).drift is None
    for capture in (video.slice(0, 1), video.slice(0, 10)):
        for given in (QUICK, replace(QUICK, only_faults=True)):
            assert denoise(capture, tiny_denoiser(), settings=given).motion.num_frames == capture.num_frames
    causal = denoise_causal(video, tiny_denoiser(), settings=QUICK, delay=0.2).motion
    away = (causal.root_position - video.root_position).norm(dim=-1)
    assert float(away.max()) < 0.1  # no floor is found on the way
    studio = replace(QUICK, capture="studio")
    assert denoise(video, tiny_denoiser(), settings=studio).drift is None


def test_white_noise_that_a_filter_leaves_is_no_drift_of_video():
    """As large as the errors of the angles explain."""
    drifting = wobbling(Performer().walks(240))
    assert correct_trajectory(drifting).from_video
    assert not correct_trajectory(drifting, explained=0.4).from_video
