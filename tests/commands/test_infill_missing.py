"""`mapctl infill` of files with NaN, as a user types it: as if their gaps had been named."""

import pytest
from captures import on_rig
from helpers import run
from lossy_files import archive_without, with_all_channels, without
from methods import words_of
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller

import mapctl

NAMES = {"canonical": ("leftHand", "rightLowerLeg"), "bandai": ("Hand_L", "LowerLeg_R"), "daz": ("lHand", "rShin")}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_infiller(tmp_path_factory.mktemp("infiller") / "tiny.safetensors", drawn=0.2)


@pytest.fixture
def infilled(tiny, tmp_path):
    """Runs the command, which must do; returns the text of what it writes."""

    def made(source, *words, method="infiller"):
        asked = () if method == "slerp" else ("--inbetweener", tiny)
        assert run("infill", source, "-o", tmp_path / "out.bvh", *words, *words_of(method), *asked, "--quiet") == 0
        return (tmp_path / "out.bvh").read_text()

    return made


@pytest.fixture
def clip(tmp_path):
    """A file by rig and rate, 1.5 seconds long, in drawn Euler orders or with the channels that a motion needs."""

    def of(rig, fps=30, seed=None):
        path, motion = tmp_path / f"{rig}-{fps}-{seed}.bvh", on_rig(rig, round(1.5 * fps), fps=fps)
        if seed is None:
            motion.save(path)
            return path
        return with_all_channels(motion, path, seed=seed)

    return of


@pytest.mark.parametrize(("rig", "fps", "seed", "method"), [("bandai", 30, 1, "auto"), ("daz", 60, 3, "slerp")])
def test_frames_of_nan_are_gaps(infilled, clip, tmp_path, rig, fps, seed, method):
    source, gaps = clip(rig, fps, seed), ((fps // 3, fps // 2), (fps, fps + 7))
    lossy = without(source, tmp_path / "lossy.bvh", [("", *gap) for gap in gaps])
    words = [word for gap in gaps for word in ("--gap", "{}:{}".format(*gap))]
    assert infilled(lossy, method=method) == infilled(source, *words, method=method)


@pytest.mark.parametrize(("rig", "gap"), [("canonical", (20, 33)), ("bandai", None), ("daz", (20, 33))])
def test_joints_of_nan_are_lost_joints(infilled, clip, tmp_path, rig, gap):
    source = clip(rig, seed=4)
    start, stop = gap or (0, 45)
    lossy = without(source, tmp_path / "lossy.bvh", [(f"{name} ", start, stop) for name in NAMES[rig]])
    words = ["--joints", ",".join(NAMES[rig]), *(["--gap", f"{start}:{stop}"] if gap else [])]
    assert infilled(lossy) == infilled(source, *words)


def test_an_archive_with_nan_is_filled(infilled, tmp_path):
    on_rig("bandai", 45).save(tmp_path / "in.npz")
    frames = (slice(20, 30),)
    lossy = archive_without(
        tmp_path / "in.npz",
        tmp_path / "lossy.npz",
        local_quat_xyzw=frames,
        root_position_world=frames,
        moving_offsets=(slice(None), *frames),
    )
    assert infilled(lossy) == infilled(tmp_path / "in.npz", "--gap", "20:30")


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        ([("", 0, 45)], "every value is nan: nothing is known of the motion"),
        ([("Hips ", 0, 45)], "the gaps leave nothing of the motion's 45 frames to go by"),
        ([("", 0, 20), ("Hips Yposition", 20, 45)], "the gaps leave nothing of the motion's 45 frames to go by"),
    ],
)
def test_where_nothing_is_left_it_is_said(tiny, clip, tmp_path, capsys, lost, said):
    lossy = without(clip("bandai"), tmp_path / "lossy.bvh", lost)
    assert run("infill", lossy, "-o", tmp_path / "out.bvh", "--inbetweener", tiny) == 2
    told = capsys.readouterr()
    assert told.err.startswith("mapctl: ")
    assert told.err.count("\n") == 1
    assert said in told.err
    assert not (tmp_path / "out.bvh").exists()


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, True])
def test_denoising_believes_no_nan(clip, tmp_path, many):
    """As if a mask said so."""
    denoiser = save_tiny_denoiser(tmp_path / "denoiser.safetensors")
    source, folder = clip("bandai"), tmp_path / "folder"
    folder.mkdir()
    lossy = without(source, folder / "lossy.bvh", [("Hand_L", 20, 26)])
    (tmp_path / "mask.csv").write_text("joint,start,stop\nHand_L,20,26\n")
    words = ["--denoiser", denoiser, "--quiet"]
    assert run("denoise", source, "-o", tmp_path / "asked.bvh", "--mask", tmp_path / "mask.csv", *words) == 0
    given, out = (folder, tmp_path / "clean") if many else (lossy, tmp_path / "out.bvh")
    assert run("denoise", given, "-o", out, *words) == 0
    made = [mapctl.load(path) for path in (tmp_path / "asked.bvh", out / "lossy.bvh" if many else out)]
    assert (made[0].joint_positions() - made[1].joint_positions()).abs().max() < 1e-6
