"""Whatever is wrong: exit status 2, one clear line on standard error, nothing written."""

from pathlib import Path

import pytest

TURNS = "Zrotation Xrotation Yrotation"
HEAD = (
    f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition {TURNS}\n"
    f"JOINT Leg\n{{\nOFFSET 0 -90 0\nCHANNELS 3 {TURNS}\nEnd Site\n{{\nOFFSET 0 -10 0\n}}\n}}\n}}\n"
    "MOTION\nFrames: 2\nFrame Time: 0.0333333\n"
)
ROW = "0 90 0 0 0 0 0 0 0\n"
DEPTH = 3000
"""Runs a command, and prints its exit status, seconds of processor time and peak of memory."""
DEEP = (
    "HIERARCHY\nROOT j\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    + "".join(f"JOINT j{k}\n{{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n" for k in range(DEPTH))
    + "}\n" * (DEPTH + 1)
    + "MOTION\nFrames: 1\nFrame Time: 0.04\n"
    + "0 " * 3 * (DEPTH + 1)
)
MOTIONS = {
    "empty": b"",
    "binary": bytes(range(256)) * 40,
    "cut": (HEAD + "0 90 0").encode(),
    "nan": (HEAD + ROW + ROW.replace("90", "nan")).encode(),
    "counts": (HEAD + "0 90 0\n" + ROW).encode(),
    "words": (HEAD + ROW + ROW.replace("90", "high")).encode(),
    "deep": DEEP.encode(),
}
CURVES = {
    "empty": b"",
    "binary": bytes(range(256)) * 40,
    "cut": b"x,z\n0,0\n1,",
    "nan": b"x,z\n0,0\n1,nan\n",
    "counts": b"x,z\n0,0\n1,1,1,1\n",
    "point": b"x,z\n0,0\n",
    "header": b"x,z\n",
}


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize(
    "words",
    [("convert", "in.bvh", "out.npz"), ("measure", "in.bvh"), ("render", "in.bvh", "-o", "out.png")],
    ids=lambda words: words[0],
)
def test_broken_motions(fails, words, kind):
    Path("in.bvh").write_bytes(MOTIONS[kind])
    assert "in.bvh" in fails(*words)


@pytest.mark.parametrize("kind", MOTIONS)
def test_broken_starts_of_generation(fails, prior, kind):
    Path("in.bvh").write_bytes(MOTIONS[kind])
    assert "in.bvh" in fails("generate", "-o", "gen", "--seconds", 1, "--start", "in.bvh", "--prior", prior)


@pytest.mark.parametrize("kind", CURVES)
def test_broken_curves(fails, prior, kind):
    Path("curve.csv").write_bytes(CURVES[kind])
    assert "curve.csv" in fails("follow", "curve.csv", "-o", "out.bvh", "--prior", prior, "--report", "out.json")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["follow", "circle:0", "-o", "a.bvh"], "radius"),
        (["follow", "circle:-4", "-o", "a.bvh"], "radius"),
        (["follow", "circle:nan", "-o", "a.bvh"], "circle"),
        (["follow", "hexagon:4", "-o", "a.bvh"], "circle"),
        (["follow", "", "-o", "a.bvh"], "circle"),
        (["follow", "nowhere.csv", "-o", "a.bvh"], "no such file"),
        (["follow", "nowhere/curve", "-o", "a.bvh"], "no such file"),
        (["follow", "line:4", "-o", "a.bvh", "--speed", "-1"], "speed must be positive, got -1 m/s"),
        (["follow", "line:4", "-o", "a.bvh", "--speed", "0"], "speed must be positive"),
        (["follow", "line:4", "-o", "a.bvh", "--speed", "nan"], "speed must be positive"),
        (["follow", "line:4", "-o", "a.bvh", "--speed", "fast"], "'fast'"),
        (["follow", "line:4", "-o", "a.bvh", "--speed", "0:1,0:2"], "rise"),
        (["follow", "line:4", "-o", "a.bvh", "--seconds", "-3"], "seconds must be positive, got -3"),
        (["follow", "line:4", "-o", "a.bvh", "--seconds", "nan"], "seconds must be positive"),
        (["follow", "line:4", "-o", "a.bvh", "--seconds", "1e9"], "fewer seconds"),
        (["follow", "line:4", "-o", "a.bvh", "--seconds", "long"], "--seconds: expected a number, got 'long'"),
        (["follow", "line:4", "-o", "a.bvh", "--seed", "1.5"], "--seed: expected a whole number, got '1.5'"),
        (["follow", "line:4", "-o", "a.bvh", "--seed", "-1"], "seed"),
        (["follow", "line:4", "-o", "a.bvh", "--seed", str(2**63)], "seed"),
        (["follow", "line:4", "-o", "a.bvh", "--prior", "nobody"], "no prior 'nobody'"),
        (["follow", "line:4", "-o", "a.bvh", "--metres-per-unit", "2"], "metres per unit"),
        (["follow", "line:4", "-o", "a.txt"], ".bvh"),
        (["follow", "line:4", "-o", "gone/a.bvh"], "does not exist"),
        (["follow", "line:4", "-o", "."], "cannot write ."),
        (["follow", "line:4", "-o", "a.bvh", "--report", "gone/a.json"], "gone"),
        (["follow", "line:4", "-o", "a.bvh", "--report", "a.bvh"], "asked for twice"),
        (["follow", "line:4", "-o", "a.bvh", "--video", "a.avi"], ".mp4"),
        (["follow", "line:4", "-o", "a.bvh", "--strct"], "Perhaps you meant: --strict"),
        (["follow", "line:4"], "--out"),
        (["follow"], "mapctl follow --help"),
        ([], "mapctl --help"),
        (["fly"], "follow"),
        (["generate", "-o", "gen", "--seconds", "0"], "seconds must be positive"),
        (["generate", "-o", "gen", "--seconds", "inf"], "seconds must be at most"),
        (["generate", "-o", "gen", "--seconds", "1", "--count", "0"], "count"),
        (["generate", "-o", "gen", "--seconds", "1", "--temperature", "-1"], "temperature"),
        (["generate", "-o", "gen", "--seconds", "1", "--style", "swim"], "knows no gait or style 'swim'"),
        (["generate", "-o", "gen", "--seconds", "1", "--refiner", "gone"], "no prior 'gone'"),
        (["generate", "-o", "gen", "--seconds", "1", "--refiner", "locomotion"], "a lstm-gmm is no refiner"),
        (["generate", "-o", "gen", "--seconds", "1", "--start", "gone.bvh"], "gone.bvh"),
        (["generate", "-o", "gen", "--seconds", "1", "--refiner", "nobody"], "no prior 'nobody'"),
        (["steer", "gone.csv", "-o", "a.bvh"], "gone.csv"),
        (["steer", "gone.csv", "-o", "a.mp4"], ".mp4"),
        (["steer", "gone.csv", "-o", "a.bvh", "--report", "a.bvh"], "asked for twice"),
        (["steer", "gone.csv", "-o", "a.bvh", "--seed", "-1"], "seed"),
        (["convert", "gone.bvh", "a.npz"], "gone.bvh"),
        (["convert", "gone.fbx", "a.npz"], ".fbx"),
        (["convert", "gone.bvh", "a.fbx"], ".fbx"),
        (["convert", "gone.bvh", "a.npz", "--fps", "0"], "frame rate"),
        (["convert", "gone.bvh", "a.npz", "--fps", "1/0"], "frame rate"),
        (["measure", "gone.bvh"], "gone.bvh"),
        (["measure", "gone.bvh", "--speed", "1"], "--curve"),
        (["measure", "gone.bvh", "--curve", "line:4", "--speed", "-1"], "speed must be positive"),
        (["render", "gone.bvh", "-o", "a.png"], "gone.bvh"),
        (["run", "gone.toml"], "gone.toml"),
        (["run", "nothing"], "ready scenes"),
        (["train", "lstm-gmm", "--data", "gone", "-o", "run"], "gone"),
        (["train", "lstm-gmm", "--data", ".", "-o", "run"], ".bvh"),
        (["train", "lstm-gmm", "--data", ".", "-o", "run", "--steps", "0"], "steps must be at least 1, got 0"),
        (["train", "refiner"], "--data"),
        (["train", "refiner", "--data", "gone", "-o", "run"], "gone is not a folder that can be read"),
        (["train", "refiner", "--data", ".", "-o", "run"], "no .bvh below"),
        (["train", "refiner", "--data", ".", "-o", "run", "--match", "("], "regular expression"),
        (["train", "refiner", "--data", ".", "-o", "run", "--density", "nobody"], "no prior 'nobody'"),
        (["train", "refiner", "--data", ".", "-o", "run", "--resume"], "no checkpoint to resume from"),
        (["train", "refiner", "--data", ".", "-o", "run", "--steps", "0"], "steps must be at least 1, got 0"),
        (["train", "refiner", "--data", ".", "-o", "run", "--window", "3"], "window must be at least"),
        (["train", "refiner", "--data", ".", "-o", "run", "--batch", "1"], "batch must be at least 2, got 1"),
        (["train", "refiner", "--data", ".", "-o", "run", "--seed", "-1"], "seed"),
        (["train", "refiner", "--data", ".", "-o", "run", "--width", "0"], "Unrecognized options: --width"),
        (
            ["train", "refiner", "--data", ".", "-o", "run", "--learning-rate", "0"],
            "Unrecognized options: --learning-rate",
        ),
        (["train", "refiner", "--data", ".", "-o", "run", "--components", "4"], "Unrecognized options: --components"),
        (["train", "refiner", "--data", ".", "-o", "run", "--labels", "(?P<a>b)"], "Unrecognized options: --labels"),
        (["train", "refiner", "--data", ".", "-o", "run", "--init", "locomotion"], "Unrecognized options: --init"),
        (["train", "gan", "--data", ".", "-o", "run"], "lstm-gmm"),
        (["info", "nobody"], "no prior 'nobody'"),
    ],
    ids=lambda value: " ".join(value)[:60] if isinstance(value, list) else "",
)
def test_impossible_requests(fails, words, said):
    assert said in fails(*words)


def test_start_beyond_the_last(fails, prior):
    assert "0 to 7" in fails("generate", "-o", "a/b", "--seconds", 1, "--start", 8, "--prior", prior)


def test_a_file_in_the_folders_place(fails, prior):
    Path("gen").write_text("here first")
    assert "not a folder" in fails("generate", "-o", "gen", "--seconds", 1, "--prior", prior)
    assert "not a folder" in fails("demo", "-o", "gen/deeper", "--prior", prior)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that not even root can write")
def test_read_only_places(fails, prior):
    assert "cannot write" in fails("follow", "line:4", "-o", "/proc/self/a.bvh", "--prior", prior)
    assert "cannot write" in fails("generate", "-o", "/proc/self/gen", "--seconds", 1, "--prior", prior)


def test_known_rigs_need_a_clip(fails):
    Path("in.bvh").write_text(HEAD + ROW + ROW)
    assert "rig" in fails("convert", "in.bvh", "out.bvh", "--rig", "canonical")


def test_weights_that_are_none(fails):
    Path("bad.safetensors").write_bytes(b"\0" * 99)
    assert "bad" in fails("follow", "line:4", "-o", "a.bvh", "--prior", "bad.safetensors")


def test_missing_extra_is_named(fails, monkeypatch):
    monkeypatch.setattr("mapctl.commands.shared.outputs.find_spec", lambda name: None)
    assert "pip install 'mapctl[render]'" in fails("follow", "line:4", "-o", "a.bvh", "--video", "a.mp4")


def test_missing_package_is_named(fails, monkeypatch):
    def run(self):
        raise ModuleNotFoundError("No module named 'viser.scene'", name="viser.scene")

    monkeypatch.setattr("mapctl.commands.info.Info.run", run)
    assert "pip install 'mapctl[live]'" in fails("info")
