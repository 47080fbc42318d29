"""`mapctl tween --variations K`: several motions through the same keys, as OUT_000.bvh, OUT_001.bvh, ...; and
`--best-of K`: one of several.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from controllers.inbetweening.keyframe_poses import KeyframeClip
from controllers.inbetweening.proposers import ModelLoaders, RolloutInbetweener, StitchedInbetweener, build_inbetweener
from controllers.inbetweening.solution import InbetweenSolution
from controllers.inbetweening.tween import measure_keyframe_errors
from controllers.inbetweening.variations import Source, Tweening, Variations, lowest_energy, sample_variations
from mapctl import report
from mapctl.commands.shared import licensing, options, results
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.shared.style import Example, find_styles, find_tweener, restyle
from mapctl.commands.tween import Tween
from mapctl.errors import RequestError
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical
from priors.stitching.inbetweener import Stitcher
from priors.tweening.styles import draw_style
from scenes.film import draw_strips_to

_MAX_ANSWERS = 1000
_IN_STYLE = " in the style of "
_FIRST_SAMPLED = 3  # the motions before it are the network's and slerp's


def number_paths(path: Path, count: int) -> list[Path]:
    """Number the paths of variations: walk_000.bvh, walk_001.bvh, ... for walk.bvh."""
    return [path.with_name(f"{path.stem}_{number:03d}{path.suffix}") for number in range(count)]


def check_answers(command: Tween, given: Sequence[Path]) -> None:
    """Raise RequestError for options that exclude several motions, and files that cannot be written."""
    options.check_seed(command.seed)
    for name, count in (("--variations", command.variations), ("--best-of", command.best_of)):
        if not 1 <= count <= _MAX_ANSWERS:
            raise RequestError(f"{name} must be 1 to {_MAX_ANSWERS}, got {count}")
        if count > 1 and command.method == "slerp":
            raise RequestError(f"--method slerp knows one answer only; leave {name} out")
    if command.dna is not None and command.best_of > 1:
        raise RequestError("--best-of keeps one of several rollouts, which know no style; leave it or --dna out")
    if command.variations > 1 and command.best_of > 1:
        raise RequestError("--variations keeps all answers and --best-of one; choose one")
    if command.variations == 1:
        # Of the stitcher, whose draws are asked for by number, one answer is the calm one whatever the seed.
        sampled = command.method in ("rollouts", "stitcher")
        if command.seed and command.best_of < _FIRST_SAMPLED and not sampled:
            raise RequestError(
                "--seed is of what is drawn, and nothing is; ask for --variations, --best-of 3 or --method rollouts"
            )
        results.check_destinations(command.out, command.video, command.report, given=given)
        return
    if command.suggest_timing:
        raise RequestError("--suggest-timing tells of one answer; leave --variations out")
    if command.video is not None and command.video.suffix.lower() != ".png":
        raise RequestError("--video of several answers is a .png of stills; film OUT_000 by `mapctl render`")
    first, *others = number_paths(command.out, command.variations)
    results.check_destinations(first, command.video, *others, command.report, given=given)


def tween_lowest_energy(command: Tween, make: Tweening, models: ModelLoaders) -> InbetweenSolution:
    """Make several motions and keep the one with the lowest energy."""
    generator = torch.Generator().manual_seed(command.seed)
    with show_progress("answers", quiet=command.quiet) as progress:
        stitched = build_inbetweener("stitcher", models) if command.method == "stitcher" else None
        source = _draw_stitches(command, stitched)
        first = {"calm": stitched} if stitched else None
        rollouts = RolloutInbetweener(models.densities(), stitched or models.network("rollouts"))
        return lowest_energy(
            make, rollouts, command.best_of, generator=generator, first=first, source=source, progress=progress
        )


def run_variations(
    command: Tween, clip: KeyframeClip, make: Tweening, models: ModelLoaders, dna: Sequence[Example]
) -> bool:
    """Make, write, report; the report lists every file with its energy. Return whether all that was requested holds."""
    generator = torch.Generator().manual_seed(command.seed)
    with show_progress("variations", quiet=command.quiet) as progress:
        first = build_inbetweener(command.method, models)
        # Where others are drawn from the density only tells energies.
        source = _draw_stitches(command, first) or _prepare_styles(command, first, dna)
        rollouts = RolloutInbetweener(models.densities(), first if source else models.network("rollouts"))
        found = sample_variations(
            make, first, rollouts, command.variations, generator=generator, source=source, progress=progress
        )
    files = number_paths(command.out, command.variations)
    rows = list(zip(found.each, files, strict=True))
    for one, file in rows:
        licensing.save_motion(one.solution.motion, file)
    if command.report is not None:
        report.write_report(_report_variations(command, clip, found, files), command.report)
    if command.video is not None:
        draw_strips_to(
            [(_name_row(one.solution, file), to_canonical(one.solution.motion, clip.rig)[0]) for one, file in rows],
            command.video,
        )
    if not command.quiet:
        _tell(found, files, len(clip.keys.frames))
    return all(one.solution.status.ok for one in found.each)


def _draw_stitches(command: Tween, first: Inbetweener | None) -> Source | None:
    """Draw from the stitcher, if it is one that was asked for."""
    if not isinstance(first, StitchedInbetweener) or not isinstance(first.stitcher, Stitcher):
        return None
    drawing, longest = first.stitcher.drawing(command.seed), first.stitcher.longest
    return Source(
        lambda number, draws: replace(first, stitcher=drawing.numbered(number)),
        "draw",
        f"whole poses with 1 to {longest} frames between them",
    )


def _prepare_styles(command: Tween, first: Inbetweener, dna: Sequence[Example]) -> Source | None:
    """Prepare the draw of styles, of those that --dna names or of the classes that the tweener knows; None for methods
    whose variations are rollouts. RequestError where there is nothing to draw from."""
    tweener = find_tweener(first)
    if tweener is None or (not dna and command.method != "tweener"):
        return None
    styles = find_styles(tweener, dna) or list(tweener.classes.values())
    if not styles:
        raise RequestError(f"{tweener.name} knows no classes of motion to draw variations from; name clips by --dna")
    order = torch.randperm(len(styles), generator=torch.Generator().manual_seed(command.seed)).tolist()

    def draw(number: int, draws: torch.Generator) -> Inbetweener:
        return restyle(first, draw_style(styles, number, tweener.encode_style, order=order, generator=draws))

    return Source(draw, "style", "room for a style")


def _tell(found: Variations, files: Sequence[Path], keys: int) -> None:
    for one, file in zip(found.each, files, strict=True):
        frames = one.solution.motion.num_frames
        print(
            f"{file}: {frames} frames through {keys} keys; energy {one.energy:.1f} nats a frame;"
            f" {1000 * one.solution.seconds / frames:.1f} ms a frame{_name_styles(one.solution)}"
        )
    print(
        f"{len(files)} variations, on average {found.diversity.world_cm:.1f} cm apart in the world and"
        f" {found.diversity.root_aligned_cm:.1f} cm seen from the hips"
    )
    first = found.each[0].solution
    for note in (*first.notes, *first.gap_notes):
        print(note)


def _name_row(made: InbetweenSolution, file: Path) -> str:
    """Name a motion in a picture: by its style, or its file."""
    named = [source.by.partition(_IN_STYLE)[2] for source in made.sources if _IN_STYLE in source.by]
    return named[0] if named else file.stem


def _name_styles(made: InbetweenSolution) -> str:
    """Name the in-betweeners that were told a style."""
    named = dict.fromkeys(source.by for source in made.sources if _IN_STYLE in source.by)
    return "".join(f"; {name}" for name in named)


def _report_variations(
    command: Tween, clip: KeyframeClip, found: Variations, files: Sequence[Path]
) -> dict[str, object]:
    rows = []
    for one, file in zip(found.each, files, strict=True):
        made = one.solution
        errors = measure_keyframe_errors(made.motion, clip.motion, clip.keys, clip.rig)
        own = {"file": str(file), "energy_nats": one.energy, "energy": one.ledger.summary(), "keys": errors}
        rows.append(own | results.build_report("tween", command, made))
    shared = ("mapctl", "request", "versions")
    each = [{key: value for key, value in row.items() if key not in shared} for row in rows]
    return {**{key: rows[0][key] for key in shared}, "diversity": found.diversity._asdict(), "variations": each}
