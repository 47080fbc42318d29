"""`mapctl make`: clips that a model and the solver make, as further training data."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import torch

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from mapctl.commands.make import Make
from mapctl.commands.make.scripts import draw_script
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.shared.resumption import explain_progress
from mapctl.errors import RequestError
from mapctl.features import GroundPose
from mapctl.formats.atomic import write_text
from mapctl.intent.steering import CommandTrack
from mapctl.metrics.mocap_bounds import CHECKED, find_bounds, list_faults, measure_checked
from mapctl.motion import Motion
from mapctl.pose import BodyPose
from priors.lstm_gmm.density import LstmGmmDensity
from priors.training.corpus import read_corpus
from priors.training.mocap.made import COLUMNS, TABLE_NAME
from priors.weight_sets import name_for_records

_MAX_CLIPS = 10_000
_LEAST_SECONDS = 3.0


def run(command: Make) -> int:
    """Check everything, then make clip after clip; those that pass stay, and their list, if it is interrupted."""
    _check(command)
    prior, frames = priors.load(command.prior), inputs.count_frames(command.seconds)
    with outputs.make_folder(command.out) as folder, explain_progress(command.count, "clips") as finished:
        bounds = find_bounds(_read_reference(command))
        if not bounds:
            raise RequestError(f"no clip below {command.reference} has a second of motion to be measured by")
        rows: list[dict[str, Any]] = []
        for number in range(command.count):
            generator = torch.Generator().manual_seed(command.seed + number)
            track, script = draw_script(prior.limits, command.seconds, generator)
            motion = _steer(prior, track, frames, generator, quiet=command.quiet)
            measures = measure_checked(motion)
            faults = list_faults(measures, bounds)
            name = f"made_{number:03d}.bvh"
            if not faults:
                motion.save(folder / name)
            rows.append(_describe(command, prior, number, name, script, measures, faults))
            write_text(folder / TABLE_NAME, _format_table(rows))
            finished(number + 1)
            if not command.quiet:
                print(f"{name}: {'kept' if not faults else 'left out: ' + '; '.join(faults)} ({script})")
    if not command.quiet:
        kept = sum(row["kept"] == "yes" for row in rows)
        print(f"kept {kept} of {len(rows)} clips; their list is {command.out / TABLE_NAME}")
    return 0


def _check(command: Make) -> None:
    options.check_seed(command.seed)
    if not 1 <= command.count <= _MAX_CLIPS:
        raise RequestError(f"the count must be 1 to {_MAX_CLIPS}, got {command.count}")
    if command.seconds < _LEAST_SECONDS:
        raise RequestError(f"a clip lasts {_LEAST_SECONDS:g} s or more, got {command.seconds:g}")
    if not command.reference.is_dir():
        raise RequestError(f"{command.reference} is not a folder of BVH files")
    outputs.check_folder(command.out)
    if (command.out / TABLE_NAME).exists():
        raise RequestError(f"{command.out} holds made clips already; choose another folder")


def _read_reference(command: Make) -> list[Motion]:
    """The mocap on the canonical body and a level floor, as what is made is."""
    corpus = read_corpus(
        command.reference, match=command.match, cache=command.out / "cache", cuts=command.cuts, level=True
    )
    return [BodyPose.of_features(clip, GroundPose.origin()).motion() for clip in corpus.clips() if len(clip) > 1]


def _steer(
    prior: LstmGmmDensity, track: CommandTrack, frames: int, generator: torch.Generator, *, quiet: bool
) -> Motion:
    recorder = Recorder()
    state, pose = steer.begin(prior, track.commands[0], generator=generator)
    recorder.show(pose, 0.0)
    with show_progress("steering", quiet=quiet):
        drive(state, track, [recorder], frames=frames)
    return recorder.motion(frames)


def _describe(
    command: Make,
    prior: LstmGmmDensity,
    number: int,
    name: str,
    script: str,
    measures: Mapping[str, float],
    faults: Sequence[str],
) -> dict[str, Any]:
    """A row of the list."""
    return {
        "file": name,
        "kept": "no" if faults else "yes",
        "model": name_for_records(prior.name),
        "licence": prior.card.licence,
        "seed": command.seed + number,
        "script": script,
        "why not": "; ".join(faults),
        **{measure: f"{value:.3g}" for measure, value in measures.items()},
    }


def _format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    table = csv.DictWriter(text, [*COLUMNS, *CHECKED], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()
