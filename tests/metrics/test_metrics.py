"""Measures against definitions written out anew, and on motions whose measures are known."""

import json
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers import random_motion, run, walk, walk_through

from mapctl import curves, metrics
from mapctl.contacts import derive_heel_contacts, detect_contacts
from mapctl.errors import RequestError
from mapctl.metrics import body, compute_reference, feet, make_comparable, measure
from mapctl.motion import Motion
from mapctl.retarget import UNKNOWN_RIG_NOTE, put_upright
from mapctl.skeleton import CANONICAL, Skeleton, find_heel_drops

TOES = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]


def straight(frames, speed=1.2, fps=30, **options):
    """A walk along +Z."""
    z = np.arange(frames) * speed / fps
    return walk_through(np.stack([np.zeros(frames), z], axis=1), fps=fps, **options)


def definitions(positions, hips, toes, fps):
    """Section 6 of the design, measure by measure, in centimetres and seconds."""
    skate, ratio, slid, stood = [], [], [], 0
    for joint in toes:
        over = positions[:, joint, 1] - np.percentile(positions[:, joint, 1], 5)
        speed = np.hypot(*np.diff(positions[:, joint], axis=0)[:, [0, 2]].T) * fps
        low = over[1:] < 0.025
        skate.append(np.where(low, speed * (2 - 2 ** (np.maximum(over[1:], 0) / 0.025)), 0))
        ratio.append((over[1:] < 0.05) & (over[:-1] < 0.05) & (speed > 0.2))
        run = []
        for frame in [*range(len(speed)), None]:
            if frame is not None and low[frame] and speed[frame] < 0.35:
                run.append(speed[frame])
                continue
            if len(run) >= round(0.1 * fps):
                slid += run
                stood += len(run)
            run = []
    third = positions[3:] - 3 * positions[2:-1] + 3 * positions[1:-2] - positions[:-3]
    ground = positions[:, hips][:, [0, 2]]
    return {
        "skate_cm_s": 100 * np.mean(skate),
        "skate_ratio": np.mean(ratio),
        "contact_speed_cm_s": 100 * np.mean(slid),
        "planted_share": stood / (2 * (len(positions) - 1)),
        "jitter_m_s3": np.sqrt((third**2).sum(-1)).mean() * fps**3,
        "speed_m_s": np.sqrt((np.diff(ground, axis=0) ** 2).sum(-1)).mean() * fps,
    }


@pytest.mark.parametrize("seed", range(4))
def test_measures_are_those_of_the_design(seed):
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(size=(120, 2)) * 0.003 + [0.0, 0.004], axis=0)
    clip = walk_through(positions, swing=0.15, wobble=0.004, seed=seed)
    expected = definitions(clip.joint_positions().numpy(), 0, TOES, 30)
    assert 0 < expected["planted_share"] < 1
    got = measure(clip)
    for name, value in expected.items():
        assert got[name] == pytest.approx(value, rel=1e-9), name


def test_sway_is_what_a_slow_gaussian_leaves():
    rng, fps = np.random.default_rng(1), 30
    offset = np.cumsum(rng.normal(size=200)) * 0.003
    taps = int(3 * 0.35 * fps)
    weights = np.exp(-0.5 * ((np.arange(-taps, taps + 1) / fps) / 0.35) ** 2)
    weights /= weights.sum()
    quick = [offset[t] - weights @ offset[t - taps : t + taps + 1] for t in range(taps, 200 - taps)]
    assert metrics.sway(torch.tensor(offset), fps) == pytest.approx(np.sqrt(np.mean(np.square(quick))), rel=1e-12)
    assert math.isnan(metrics.sway(torch.tensor(offset[: 2 * taps + 4]), fps))


def test_path_error_is_the_distance_to_the_curve():
    angle = np.linspace(0, 3, 200)
    radius = 2 + 0.05 * np.cos(3 * angle)
    positions = np.stack([2 - radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    got = measure(walk_through(positions, headings=angle), curves.circle(radius=2.0))
    expected = 100 * np.abs(radius - 2)
    assert got["path_error_mean_cm"] == pytest.approx(expected.mean(), abs=0.001)
    assert got["path_error_p95_cm"] == pytest.approx(np.percentile(expected, 95), abs=0.001)
    assert got["path_error_max_cm"] == pytest.approx(expected.max(), abs=0.001)


@pytest.mark.parametrize("fps", [25, 30, 120])
def test_progress_is_measured_along_the_arc(fps):
    curve = curves.figure8(radius=1.0)
    arcs = torch.linspace(0, 1.5 * curve.length, 12 * fps + 1, dtype=torch.float64)
    got = measure(walk_through(curve.point(arcs), fps=fps), curve, speed=2.0)
    assert got["travelled_m"] == pytest.approx(6 * math.pi, rel=1e-3)
    assert got["wanted_m"] == pytest.approx(24.0)
    assert got["progress_ratio"] == pytest.approx(6 * math.pi / 24, rel=1e-3)
    assert got["path_error_max_cm"] < 1e-3
    assert got["speed_m_s"] == pytest.approx(math.pi / 2, rel=0.01)


def test_penetration_and_float_of_planted_toes():
    toes = torch.zeros(100, 1, 3, dtype=torch.float64)
    toes[:10, 0, 1], toes[10:, 0, 1] = 0.0, 0.01  # a tenth of the frames is the floor
    found = feet.ToeMeasurements.of(toes, 30)
    assert feet.float_height(found) == pytest.approx(0.009)
    assert feet.penetration(found) == 0.0
    toes[:3, 0, 1] = -0.02  # too few to be the floor
    found = feet.ToeMeasurements.of(toes, 30)
    assert feet.penetration(found) == pytest.approx(3 * 0.02 / 100, rel=1e-9)


def test_a_reference_is_mean_and_percentiles_over_clips():
    speeds = np.array([0.5, 1.0, 1.5, 2.0, 1.0])
    clips = [straight(frames, speed=speed) for frames, speed in zip((90, 90, 90, 90, 3), speeds, strict=True)]
    table = compute_reference(iter(clips))
    assert table["speed_m_s"] == pytest.approx((speeds.mean(), *np.percentile(speeds, [2, 98])))
    assert not math.isnan(table["sway_cm"].mean)  # the clip of 3 frames has none and is left out
    with pytest.raises(RequestError):
        compute_reference([])


def test_heels_are_measured_by_their_definition():
    clip = walk(120, turn_rate=0.6)
    got, heels = measure(clip), feet.locate_heels(feet.level_feet(clip))
    toes = clip.joint_positions()[:, TOES]
    drops = torch.tensor(find_heel_drops(feet.level_feet(clip).skeleton))
    planted = derive_heel_contacts(detect_contacts(toes, 30), toes, heels, drops, 30.0).numpy()
    positions, forward = heels[..., ::2].numpy(), (toes - heels)[..., ::2].numpy()
    speeds, turns, slides = [], [], []
    for side in range(2):
        start = None
        for t in range(120):
            if not planted[t, side]:
                start = None
                continue
            start = positions[t, side] if start is None else start
            slides.append(np.hypot(*(positions[t, side] - start)))
            if t and planted[t - 1, side]:
                speeds.append(np.hypot(*(positions[t, side] - positions[t - 1, side])) * 30)
                was, now = (math.atan2(*forward[k, side]) for k in (t - 1, t))
                turns.append(abs(math.remainder(now - was, 2 * math.pi)) * 30)
    assert got["heel_contact_speed_cm_s"] == pytest.approx(100 * np.mean(speeds))
    assert got["heel_slide_max_cm"] == pytest.approx(100 * max(slides))
    assert got["foot_turn_deg_s"] == pytest.approx(math.degrees(np.mean(turns)))
    assert got["heel_planted_share"] == pytest.approx(planted[1:].mean())
    assert 0.1 < got["heel_planted_share"] < 0.8
    assert got["foot_turn_deg_s"] > 5


TOES = [CANONICAL.index(name) for name in ("leftToes", "rightToes")]
HANDS = [CANONICAL.index(name) for name in ("leftHand", "rightHand")]


@pytest.mark.parametrize("fps", [30, 60])
def test_a_jump_of_one_frame_is_the_largest_step_whatever_the_body_does(fps):
    motion = walk(2 * fps, fps=fps)
    positions = motion.joint_positions()
    ends = positions[:, HANDS].clone()
    calm = body.measure_peaks(ends, positions[:, 0], fps)
    ends[fps, 0] += torch.tensor([0.0, 0.6, 0.0]).double()
    peaks = body.measure_peaks(ends, positions[:, 0], fps)
    assert peaks.step == pytest.approx(0.6 * fps / 30, abs=calm.step)
    assert peaks.acceleration == pytest.approx(1.2 * fps**2, abs=calm.acceleration)
    shifted = body.measure_peaks(
        ends + torch.arange(2 * fps)[:, None, None], positions[:, 0] + torch.arange(2 * fps)[:, None], fps
    )
    assert shifted == pytest.approx(peaks)


def independent(toes, hips, fps):
    """The same by the letter of the definition, frame by frame."""
    floor, best, run = np.percentile(toes[..., 1], 5, axis=0), 0, 0
    for t in range(1, len(toes)):
        speeds = [np.hypot(*(toes[t, k] - toes[t - 1, k])[[0, 2]]) * fps for k in range(2)]
        low = [toes[t, k, 1] - floor[k] for k in range(2)]
        carried = any(low[k] < 0.03 and speeds[k] < 0.35 for k in range(2))
        goes = np.hypot(*(hips[t] - hips[t - 1])[[0, 2]]) * fps > 0.3
        run = run + 1 if not carried and min(low) < 0.05 and goes else 0
        best = max(best, run)
    return best / fps


@pytest.mark.parametrize("slide", [0.0, 0.01, 0.02, 0.05])
def test_the_longest_time_unsupported_is_that_of_the_definition(slide):
    motion = walk(90)
    toes, hips = (motion.joint_positions()[:, joints].clone() for joints in (TOES, [0]))
    shift = torch.arange(90).clamp(min=30, max=70)[:, None] * torch.tensor([slide, 0.0, 0.0]).double()
    toes, hips = toes + shift[:, None], hips[:, 0] + shift
    assert body.measure_longest_unsupported(toes, hips, 30.0) == pytest.approx(
        independent(toes.numpy(), hips.numpy(), 30.0)
    )
    assert (body.measure_longest_unsupported(toes, hips, 30.0) > 0.5) == (slide > 0.005)


def given(capsys, *words: object) -> dict:
    assert run("measure", *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("fps", "said"), [(Fraction(30000, 1001), False), (Fraction(24), True), (Fraction(15), True)])
def test_slower_files_stay_as_they_are_with_a_note(fps, said):
    motion = replace(walk(60), fps=fps)
    comparable, notes = make_comparable(motion)
    assert comparable.num_frames == 60
    assert bool(notes) == said
    assert all("frames a second" in note for note in notes)


def unknown() -> Motion:
    """A skeleton that is no body but has hips, feet and thighs by name."""
    names = ("Hips", "LeftUpLeg", "LeftFoot", "RightUpLeg", "RightFoot")
    offsets = torch.tensor([[0, 0, 0], [0.1, 0, 0], [0, -0.8, 0], [-0.1, 0, 0], [0, -0.8, 0]], dtype=torch.float64)
    return random_motion(Skeleton(names, (-1, 0, 1, 0, 3), offsets), 40)


def test_unknown_parts_of_a_rig_are_refused_in_one_line(tmp_path, capsys):
    unknown().save(tmp_path / "a.bvh")
    values = given(capsys, tmp_path / "a.bvh")
    assert values["notes"] == [f"{tmp_path / 'a.bvh'}: {UNKNOWN_RIG_NOTE}"]
    assert values["measures"]["jitter_m_s3"] == pytest.approx(metrics.measure(unknown())["jitter_m_s3"], rel=1e-3)
    assert run("measure", tmp_path / "a.bvh") == 0
    assert UNKNOWN_RIG_NOTE in capsys.readouterr().out
    assert put_upright(unknown())[1] == (UNKNOWN_RIG_NOTE,)
