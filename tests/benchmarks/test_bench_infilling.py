"""What infilling is worth: the table's rows, what networks are shown of the truth, and where clips come from."""

import json
from dataclasses import replace

import pytest
import torch
from helpers import run, walk
from tiny_infiller import CONFIG, card, network, save_tiny_infiller, tiny_infiller

from controllers.benchmarks import infilling
from controllers.benchmarks.infilling import TASKS, Task, benchmark_infilling, scale_to_canonical_bones, slice_middle
from mapctl import retarget
from mapctl.inbetweening import ProposedPositions
from mapctl.protocols import PositionInfiller
from priors import checkpoints
from priors.infiller.network import ConvInfiller

SOME = (
    Task("nothing missing", 40),
    Task("gap", 40, 10),
    Task("noise", 40, noise=0.03),
    Task("dropped", 40, dropout=0.4),
    Task("longer than any", 400, 10),
)
COLUMNS = {"task", "clips", "method", "error_cm", "std_cm", "bones_mm"}


@pytest.fixture
def clips():
    return [walk(50, turn_rate=0.5), walk(20)]


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """As the whole table would take long."""
    monkeypatch.setattr(infilling, "TASKS", SOME)


def rows_of(rows, task):
    return {row["method"]: row for row in rows if row["task"] == task}


def vanilla():
    config = replace(CONFIG, architecture="vanilla")
    return ConvInfiller("vanilla", network(config=config), card())


@pytest.fixture(scope="module")
def rows():
    """Of a network with drawn weights and of a baseline."""
    networks, told = {"skips": tiny_infiller(drawn=0.1), "vanilla": vanilla()}, []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(infilling, "TASKS", SOME)
        rows = benchmark_infilling(
            [walk(40, turn_rate=-1.0, seed=2)],
            networks,
            ours="skips",
            progress=lambda done, of: told.append((done, of)),
        )
    assert told == [(number + 1, len(SOME)) for number in range(len(SOME))]
    return rows


@pytest.mark.slow
def test_every_task_has_every_method_and_gaps_have_more(rows):
    assert all(set(row) == COLUMNS for row in rows)
    assert all(row["clips"] == 1 for row in rows)
    raw = ["skips, raw", "vanilla, raw"]
    for task in ("nothing missing", "noise", "dropped"):
        assert list(rows_of(rows, task)) == raw
    assert list(rows_of(rows, "gap")) == [*raw, "skips, on rigid bones", "skips, and MAP", "interpolation"]


def test_with_nothing_missing_skips_changes_nothing_and_an_autoencoder_does(rows):
    found = rows_of(rows, "nothing missing")
    assert found["skips, raw"]["error_cm"] < 1e-4
    assert found["skips, raw"]["bones_mm"] < 1e-2
    assert found["vanilla, raw"]["error_cm"] > 1


def test_bones_are_rigid_but_for_networks_as_they_are(rows):
    found = rows_of(rows, "gap")
    assert found["skips, raw"]["bones_mm"] > 1
    assert max(row["bones_mm"] for method, row in found.items() if "raw" not in method) < 1e-6


@pytest.mark.slow
def test_an_untrained_network_is_interpolation_and_no_better(clips, monkeypatch):
    """It gives back the guess that it was shown: were that the truth, it would be perfect."""
    monkeypatch.setattr(infilling, "TASKS", SOME[1:2])
    found, again = (
        rows_of(benchmark_infilling(clips, {"skips": tiny_infiller()}, ours="skips"), "gap") for _ in range(2)
    )
    assert found == again
    assert found["interpolation"]["error_cm"] > 0.5
    assert found["skips, raw"]["error_cm"] == pytest.approx(found["interpolation"]["error_cm"], rel=1e-5)


class Keeping(PositionInfiller):
    """Keeps the images that it is shown."""

    def __init__(self):
        self.images = []

    def complete(self, image):
        """As it was shown."""
        self.images.append(image)
        return ProposedPositions(image.places, torch.zeros_like(image.contacts))


@pytest.mark.parametrize("task", [SOME[1], SOME[3]], ids=lambda task: task.name)
def test_networks_are_not_shown_what_is_missing(clips, monkeypatch, task):
    """What is known is the truth, and what is not is some way from it."""
    monkeypatch.setattr(infilling, "TASKS", (task,))
    keeping = Keeping()
    benchmark_infilling(clips[:1], {"skips": keeping}, ours="skips")
    image = keeping.images[0]
    truth = slice_middle(scale_to_canonical_bones(clips[0]), task.frames).joint_positions().float()
    places = image.to_world(image.places)[0]
    known = image.known[0]
    assert (~known).any()
    assert (places - truth)[known].abs().max() < 1e-5
    assert (places - truth)[~known].norm(dim=-1).mean() > 0.002


def test_tasks_that_no_clip_is_long_enough_for_have_no_rows(clips):
    rows = benchmark_infilling([clips[0].slice(0, 20)], {"skips": tiny_infiller()}, ours="skips")
    assert rows == []


def test_the_papers_tasks_are_there():
    names = [task.name for task in TASKS]
    assert len(set(names)) == len(names)
    assert names[:4] == ["nothing missing", "gap of 0.5 s", "gap of 1 s", "gap of 2 s"]
    assert all(0 <= task.gap < task.frames and (task.frames - task.gap) % 2 in (0, 1) for task in TASKS)


def test_clips_come_to_canonical_bones_and_the_priors_rate_from_any_size():
    motion = walk(120, fps=60)
    large = replace(
        motion,
        skeleton=replace(motion.skeleton, offsets=1.3 * motion.skeleton.offsets),
        root_position=1.3 * motion.root_position,
    )
    first, second = (scale_to_canonical_bones(each) for each in (motion, large))
    assert (first.num_frames, float(first.fps)) == (60, 30)
    assert torch.allclose(first.joint_positions(), second.joint_positions(), atol=1e-9)
    assert slice_middle(first, 20).num_frames == 20
    assert torch.equal(slice_middle(first, 20).root_position, first.root_position[20:40])


@pytest.fixture
def folder(tmp_path):
    """Two clips that training did not see, and an infiller whose card says so."""
    for number, motion in enumerate([walk(50, turn_rate=0.5), walk(45, turn_rate=-1.0)]):
        path = tmp_path / "data" / "bandai" / f"a_walk_{number}.bvh"
        path.parent.mkdir(parents=True, exist_ok=True)
        retarget.from_canonical(motion, retarget.identify_rig(motion.skeleton)).save(path)
    held = {"validation": ["bandai/a_walk_0.bvh"], "test": ["bandai/a_walk_1.bvh"]}
    told = replace(card(), data={"held_out": held})
    checkpoints.save(network(drawn=0.1).state_dict(), told, tmp_path / "ours.safetensors")
    return tmp_path


@pytest.mark.slow
def test_the_command_compares_networks_on_the_clips_kept_from_training(folder, capsys):
    other = save_tiny_infiller(folder / "other.safetensors")
    words = [
        "--infiller",
        folder / "ours.safetensors",
        "--inbetweener",
        folder / "ours.safetensors",
        "--data",
        folder / "data",
        "--count",
        10,
        "--json",
    ]
    assert run("bench", "infill", *words, "--baselines", other) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bench"] == "infill"
    assert {row["task"] for row in told["rows"]} == {"nothing missing", "gap", "noise", "dropped"}
    assert all(set(row) == COLUMNS and row["clips"] == 2 for row in told["rows"])
    # Of the same kind, and none takes the other's place.
    drawn, plain = (rows_of(told["rows"], "gap")[f"{name}, raw"] for name in ("skips", f"skips {other}"))
    assert drawn["bones_mm"] > 100 * plain["bones_mm"]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (None, "Missing from mapctl bench infill: --data DIR The folder that was trained on"),
        ("empty", "does not hold the clips kept from training"),
    ],
)
def test_the_clips_kept_from_training_are_asked_for(folder, capsys, data, said):
    (folder / "empty").mkdir()
    words = [] if data is None else ["--data", folder / data]
    assert run("bench", "infill", "--infiller", folder / "ours.safetensors", *words) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert told.err.count("\n") == 1
