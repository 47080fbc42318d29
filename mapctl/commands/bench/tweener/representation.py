"""`mapctl bench representation`: which numbers a network should tell rotations by, and what the joints' ranges leave
out."""

import tempfile
from contextlib import ExitStack
from pathlib import Path

import torch

from controllers.benchmarks.shared.tables import Row
from mapctl import joint_ranges
from mapctl.commands.bench import Representation
from mapctl.commands.bench.output import print_rows
from mapctl.commands.shared.options import check_seed
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from priors.training.corpus import Corpus, read_corpus, split_corpus
from priors.tweening.measure_ranges import measure_fit
from priors.tweening.representations import (
    IkErrors,
    IkSettings,
    list_representations,
    measure_inverse_kinematics,
    measure_mean_pose,
    place_poses,
    train_inverse_kinematics,
)


def run(table: Representation) -> int:
    """Train, measure and print."""
    check_seed(table.seed)
    settings = IkSettings(steps=table.steps, seed=table.seed)
    corpus = _read(table.data, table.cache)
    split = split_corpus(corpus, table.seed)
    train = place_poses(split.train.features)
    held_out = place_poses(torch.cat([split.validation.features, split.test.features]))
    rows = [_format("mean pose, told the heading", measure_mean_pose(train, held_out))]
    for representation in list_representations():
        with show_progress(representation.name) as progress:
            network = train_inverse_kinematics(representation, train, settings, progress=progress)
        found = measure_inverse_kinematics(representation, network, held_out, seed=table.seed)
        rows.append({**_format(representation.name, found), "steps": table.steps})
    fit = measure_fit(joint_ranges.load(), corpus.features)
    rows.append({"by": "nearest poses within the ranges", "mean_cm": fit["nearest_pose_cm"], **_tell_outside(fit)})
    return print_rows(table, rows)


def _read(data: Path, cache: Path | None) -> Corpus:
    if not data.is_dir():
        raise RequestError(f"{data}: no such folder")
    with ExitStack() as stack, show_progress("read") as progress:
        kept = cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        return read_corpus(data, match="", cache=kept, skip_first=True, progress=progress)


def _format(by: str, errors: IkErrors) -> Row:
    return {"by": by, "mean_cm": errors.mean, "max_cm": errors.largest, "std_cm": errors.deviation}


def _tell_outside(fit: dict[str, float]) -> Row:
    return {"outside_percent": fit["outside_percent"]}
