"""`mapctl tween --variations K`: several motions through the same keys, as OUT_000.bvh, OUT_001.bvh, ...; and
`--best-of K`: one of several.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import priors
from controllers.inbetweening.keyframe_poses import KeyframeClip
from controllers.inbetweening.pipeline import InfillResult, InfillSettings
from controllers.inbetweening.tween import measure_keyframe_errors
from controllers.inbetweening.variations import Variations, lowest_energy, sample_variations
from mapctl import formats, report
from mapctl.commands.shared import options, results
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.tween import Tween
from mapctl.errors import RequestError
from mapctl.protocols import Inbetweener

_MAX_ANSWERS = 1000
_FIRST_SAMPLED = 3  # answers before it are the infiller's and slerp's


def number_paths(path: Path, count: int) -> list[Path]:
    """walk_000.bvh, walk_001.bvh, ... of walk.bvh."""
    return [path.with_name(f"{path.stem}_{number:03d}{path.suffix}") for number in range(count)]


def check_answers(command: Tween, given: Sequence[Path]) -> None:
    """RequestError for what several answers cannot be made of, and files that cannot be written."""
    options.check_seed(command.seed)
    for name, count in (("--variations", command.variations), ("--best-of", command.best_of)):
        if not 1 <= count <= _MAX_ANSWERS:
            raise RequestError(f"{name} must be 1 to {_MAX_ANSWERS}, got {count}")
        if count > 1 and command.method == "slerp":
            raise RequestError(f"--method slerp knows one answer only; leave {name} out")
    if command.variations > 1 and command.best_of > 1:
        raise RequestError("--variations keeps all answers and --best-of one; choose one")
    if command.variations == 1:
        if command.seed and command.best_of < _FIRST_SAMPLED:
            raise RequestError("--seed is of what is drawn, and nothing is; ask for --variations or --best-of 3")
        results.check_destinations(command.out, command.video, command.report, given=given)
        return
    if command.suggest_timing:
        raise RequestError("--suggest-timing tells of one answer; leave --variations out")
    if command.video is not None:
        raise RequestError("--video shows one answer; leave it out, and film OUT_000 by `mapctl render`")
    first, *others = number_paths(command.out, command.variations)
    results.check_destinations(first, None, *others, command.report, given=given)


def tween_lowest_energy(
    command: Tween, asked: KeyframeClip, infiller: Inbetweener, settings: InfillSettings
) -> InfillResult:
    """The likeliest of several answers."""
    with show_progress("answers", quiet=command.quiet) as progress:
        return lowest_energy(
            asked.motion,
            asked.keys,
            infiller,
            command.best_of,
            settings=settings,
            **_load_rollout_arguments(command, asked),
            progress=progress,
        )


def run_variations(command: Tween, asked: KeyframeClip) -> None:
    """Make, write, tell; the report names every file with its energy."""
    found = _make_variations(command, asked)
    files = number_paths(command.out, command.variations)
    for one, file in zip(found.each, files, strict=True):
        formats.save(one.infill_result.motion, file)
    if command.report is not None:
        report.write_report(_report_variations(command, asked, found, files), command.report)
    if not command.quiet:
        for one, file in zip(found.each, files, strict=True):
            frames = one.infill_result.motion.num_frames
            ms = 1000 * one.infill_result.seconds / frames
            print(
                f"{file}: {frames} frames through {len(asked.keys.frames)} keys; energy {one.energy:.1f} nats a"
                f" frame; {ms:.1f} ms a frame"
            )
        print(
            f"{len(files)} variations, on average {found.diversity.world_cm:.1f} cm apart in the world and"
            f" {found.diversity.root_aligned_cm:.1f} cm seen from the hips"
        )
        first = found.each[0].infill_result
        for note in (*first.notes, *first.gap_notes):
            print(note)


def _make_variations(command: Tween, asked: KeyframeClip) -> Variations:
    settings = InfillSettings(method="infiller" if command.method == "infiller" else "map")
    infiller = priors.load_infiller(command.infiller or "infiller")
    with show_progress("variations", quiet=command.quiet) as progress:
        return sample_variations(
            asked.motion,
            asked.keys,
            infiller,
            command.variations,
            settings=settings,
            **_load_rollout_arguments(command, asked),
            progress=progress,
        )


def _load_rollout_arguments(command: Tween, asked: KeyframeClip) -> dict[str, Any]:
    """What rollouts are made by, and the rig."""
    return {
        "rollout_densities": priors.load_choice(command.prior or "auto"),
        "densities": priors.load_choice(command.prior),
        "generator": torch.Generator().manual_seed(command.seed),
        "rig": asked.rig,
    }


def _report_variations(command: Tween, asked: KeyframeClip, found: Variations, files: list[Path]) -> dict[str, Any]:
    rows = []
    for one, file in zip(found.each, files, strict=True):
        made = one.infill_result
        told = {"keys": measure_keyframe_errors(made.motion, asked.motion, asked.keys, asked.rig), **made.summary()}
        rows.append(
            {
                "file": str(file),
                "energy_nats": one.energy,
                "energy": one.ledger.summary(),
                **results.build_report("tween", command, made.motion, told),
            }
        )
    shared = ("mapctl", "request", "versions")
    own = [{key: value for key, value in row.items() if key not in shared} for row in rows]
    return {**{key: rows[0][key] for key in shared}, "diversity": found.diversity._asdict(), "variations": own}
