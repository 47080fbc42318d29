"""Only the faults of a capture are repaired: listed at their spans, and all else stays to the bit in the file."""

import json
from dataclasses import replace

import pytest
import torch
from captures import error_cm, swaying
from helpers import quat_xyzw, run
from performers import Performer
from scipy.ndimage import gaussian_filter1d
from tiny_denoiser import QUICK, save_tiny_denoiser, tiny_denoiser

import mapctl
from controllers.denoising.causal import CausalDenoiser
from controllers.denoising.denoise import DenoiseSettings, denoise
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats import bvh
from mapctl.metrics.faults import list_faults
from mapctl.numerics.easing import smootherstep
from mapctl.problem.solution import Outcome
from mapctl.skeleton import CANONICAL, TOES

FPS, FRAMES = 30, 240
ARMS = [CANONICAL.index(side + part) for side in ("left", "right") for part in ("UpperArm", "LowerArm")]
ELBOW, SHOULDER = "leftLowerArm", "rightUpperArm"
SETTINGS = replace(QUICK, only_faults=True)


def with_arms(motion):
    """The motion with arms that sway."""
    quats = motion.local_quat_xyzw.clone()
    quats[:, ARMS] = swaying(motion.num_frames, len(ARMS), fps=FPS)
    return replace(motion, local_quat_xyzw=quats)


def ramp(start, stop, frames=FRAMES, fade=5):
    """Rises from 0 to 1 within `fade` frames from `start` on, and falls back before `stop`."""
    time = torch.arange(frames, dtype=torch.float64)
    return smootherstep((time - start) / fade) * smootherstep((stop - time) / fade)


def lifted(motion, height, start, stop):
    return replace(
        motion, root_position=motion.root_position + height * ramp(start, stop)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    )


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A walk as it is read from a file, whose joints have an order of their own."""
    path = tmp_path_factory.mktemp("truth") / "walk.bvh"
    with_arms(Performer().walks(FRAMES, FPS)).save(path)
    return mapctl.load(path)


@pytest.fixture
def repair(tmp_path):
    """Writes a motion, repairs what is read from the file, and writes it; returns the result and both files' rows."""

    def repaired(motion):
        paths = tmp_path / "in.bvh", tmp_path / "out.bvh"
        motion.save(paths[0])
        done = denoise(mapctl.load(paths[0]), tiny_denoiser(), settings=SETTINGS)
        done.motion.save(paths[1])
        texts = [path.read_text().split("MOTION") for path in paths]
        assert texts[0][0] == texts[1][0]
        return done, *([row.split() for row in text[1].splitlines()[3:]] for text in texts)

    return repaired


def find_changes(motion, before, after):
    """Frames in which any number of a row differs, and the joints of which any ever does."""
    labels = [label.split()[0] for label in bvh.choose_layout(motion, "a.bvh").hierarchy.labels()]
    assert len(before) == len(after) == FRAMES
    changed = [(t, labels[c]) for t in range(FRAMES) for c in range(len(labels)) if before[t][c] != after[t][c]]
    return {t for t, _ in changed}, {joint for _, joint in changed}


def roughness(motion, part=""):
    """Largest third difference of joints with such a part in their name, metres."""
    joints = [joint for joint, name in enumerate(motion.skeleton.names) if part in name]
    return float(motion.joint_positions()[:, joints].diff(n=3, dim=0).norm(dim=-1).max())


def test_a_clean_capture_is_the_same_file(truth, repair):
    done, before, after = repair(truth)
    assert before == after
    assert done.faults == ()
    assert done.status.outcome is Outcome.DONE


def test_a_spike_and_a_held_joint_are_repaired_and_all_else_stays(truth, repair):
    quats = truth.local_quat_xyzw.clone()
    leap = quat_xyzw(torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64))
    elbow, shoulder = truth.skeleton.indices((ELBOW, SHOULDER))
    quats[40, elbow] = rotations.multiply(quats[40, elbow], leap)
    quats[70:95, shoulder] = quats[70, shoulder]
    given = replace(truth, local_quat_xyzw=quats)
    done, before, after = repair(given)
    assert {(f.kind, f.joint, f.start, f.stop) for f in done.faults} == {
        ("spike", ELBOW, 40, 41),
        ("dropout", SHOULDER, 71, 95),
    }
    (height,) = [fault.amount for fault in done.faults if fault.kind == "spike"]
    assert height == pytest.approx(28.6, abs=3)
    frames, joints = find_changes(done.motion, before, after)
    assert frames == {40, *range(71, 95)}
    assert joints == {ELBOW, SHOULDER}
    assert error_cm(truth, done.motion) < error_cm(truth, given)
    spike, repaired = (error_cm(truth.slice(40, 41), each.slice(40, 41)) for each in (given, done.motion))
    assert repaired < 0.1 * spike
    assert roughness(done.motion, "Hand") < 0.1 * roughness(given, "Hand")
    assert done.status.outcome is Outcome.DONE


def test_frozen_frames_are_filled_and_no_foot_is_blamed(truth, repair):
    index = torch.arange(FRAMES)
    index[100:112] = 100
    done, before, after = repair(truth.pick(index))
    assert [(f.kind, f.start, f.stop) for f in done.faults] == [("frozen", 101, 112)]
    assert find_changes(done.motion, before, after)[0] == set(range(101, 112))


@pytest.mark.parametrize(("height", "kind"), [(0.06, "float"), (-0.06, "penetration")])
def test_a_body_off_its_floor_is_brought_back_by_hips_and_legs(truth, repair, height, kind):
    given = lifted(truth, height, 120, 160)
    done, before, after = repair(given)
    assert {fault.kind for fault in done.faults} == {kind}
    assert all(118 < fault.start < fault.stop < 162 and 4 < fault.amount < 7 for fault in done.faults)
    frames, joints = find_changes(done.motion, before, after)
    edges = (min(fault.start for fault in done.faults), max(fault.stop for fault in done.faults))
    assert frames <= set(range(edges[0] - 9, edges[1] + 9))
    assert joints <= {"hips", *(side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot"))}
    away = (done.motion.joint_positions() - truth.joint_positions()).norm(dim=-1)[sorted(frames)]
    assert float(away.mean()) < 0.35 * abs(height)
    assert roughness(done.motion) < 1.01 * roughness(given)
    assert list_faults(done.motion) == []


def test_a_slide_between_two_stands_stays_and_is_named(repair):
    """Where both feet stand before and after it, only steps could lead from one position to the other."""
    standing = with_arms(Performer().stands(FRAMES, FPS))
    along = smootherstep((torch.arange(FRAMES, dtype=torch.float64) - 100) / 24)[:, None]
    given = replace(standing, root_position=standing.root_position + along * torch.tensor([0.3, 0.0, 0.0]))
    done, before, after = repair(given)
    assert {(fault.kind, fault.joint) for fault in done.faults} == {("slide", toe) for toe in TOES}
    assert all(100 <= fault.start < fault.stop <= 125 for fault in done.faults)
    assert before == after
    assert done.status.outcome is Outcome.INFEASIBLE
    assert "slide of leftToes in 10" in done.status.text


def test_noise_stays_and_is_named(truth):
    quats = rotations.multiply(
        truth.local_quat_xyzw,
        quat_xyzw(0.03 * torch.randn(FRAMES, 21, 3, generator=torch.Generator().manual_seed(0)).double()),
    )
    done = denoise(replace(truth, local_quat_xyzw=quats), tiny_denoiser(), settings=SETTINGS)
    assert {fault.kind for fault in done.faults} >= {"noise"}
    assert any("noise" in note for note in done.notes)
    same = (done.motion.local_quat_xyzw == quats).all(dim=-1).double().mean()
    assert same > 0.9


def test_a_smoothed_span_of_a_capture_is_listed_and_named(truth):
    """Trembling by 0.1 degrees, as in captures, is smoothed away for a second."""
    shake = 0.002 * torch.randn(FRAMES, 21, 3, generator=torch.Generator().manual_seed(0)).double()
    quats = rotations.multiply(truth.local_quat_xyzw, quat_xyzw(shake))
    given = replace(truth, local_quat_xyzw=quats)
    assert "smoothed" not in {fault.kind for fault in list_faults(given)}
    smooth = torch.from_numpy(gaussian_filter1d(quats.numpy(), 3, axis=0))
    quats = torch.cat([quats[:80], torch.nn.functional.normalize(smooth[80:120], dim=-1), quats[120:]])
    done = denoise(replace(given, local_quat_xyzw=quats), tiny_denoiser(), settings=SETTINGS)
    (fault,) = [fault for fault in done.faults if fault.kind == "smoothed"]
    assert fault.start == pytest.approx(80, abs=6)
    assert fault.stop == pytest.approx(120, abs=6)
    assert "not repaired: " in done.status.text
    assert "smoothed of *" in done.status.text


def test_what_does_not_go_together_is_refused():
    with pytest.raises(RequestError, match="causal"):
        CausalDenoiser(tiny_denoiser(), settings=SETTINGS)
    with pytest.raises(RequestError, match="video"):
        DenoiseSettings(only_faults=True, capture="video")


def test_measure_lists_faults_and_denoise_repairs_them(truth, tmp_path, capsys):
    tiny, paths = save_tiny_denoiser(tmp_path / "tiny.safetensors"), (tmp_path / "in.bvh", tmp_path / "out.bvh")
    lifted(truth, 0.06, 120, 160).save(paths[0])
    assert run("measure", paths[0], "--json") == 0
    faults = json.loads(capsys.readouterr().out)["faults"]
    assert {fault["kind"] for fault in faults} == {"float"}
    assert faults[0]["start_s"] == pytest.approx(faults[0]["start"] / FPS)
    amounts = [fault["amount"] for fault in faults]
    assert amounts == sorted(amounts, reverse=True)
    assert run("measure", paths[0]) == 0
    assert f"faults: {len(faults)}" in capsys.readouterr().out
    assert run("denoise", paths[0], "-o", paths[1], "--only-faults", "--strict", "--denoiser", tiny) == 0
    assert "only faults are repaired" in capsys.readouterr().out
    assert run("measure", paths[1]) == 0
    assert "faults: none" in capsys.readouterr().out
    for words, named in ((["--causal"], "--causal"), (["--capture", "video"], "video")):
        assert run("denoise", paths[0], "-o", tmp_path / "no.bvh", "--only-faults", *words, "--denoiser", tiny) == 2
        assert named in capsys.readouterr().err
