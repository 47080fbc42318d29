"""`mapctl tween`: a motion through keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from tyro.conf import arg

import priors
from controllers.inbetweening.keyframes import KeyframeClip, KeyInterval, build_keyframe_clip, suggest_intervals
from controllers.inbetweening.pipeline import InbetweenSolution, InfillSettings
from controllers.inbetweening.proposers import ModelLoaders, RolloutInbetweener, StitchedInbetweener, build_inbetweener
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from controllers.inbetweening.variations import Source, Tweening, Variations, sample_variations
from mapctl import report
from mapctl.commands.shared import inputs, options, outputs, results
from mapctl.commands.shared.command import NOT_SATISFIED, ModelCommand, conclude
from mapctl.commands.shared.options import parse_frame
from mapctl.commands.shared.outputs import print_table, show_progress
from mapctl.commands.shared.results import Example, find_styles, find_tweener, read_dna, restyle
from mapctl.errors import FileFormatError, RequestError
from mapctl.intent.keyframes import KeyRequest, Keys, read_keys
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from priors import weight_sets
from priors.stitcher import Stitcher
from priors.tweener import draw_style
from scenes.film import draw_strips_to


@dataclass(frozen=True)
class Tween(ModelCommand, options.RigOptions, options.ProposalOptions):
    """Make the motion between keyframes: frames of a clip, or poses that a file sets in time and space. On any known
    rig."""

    source: options.InFile
    """A motion file; or a TOML file of [[key]] tables: a frame or seconds, a pose (a motion file and a pose_frame of
    it), a place = [x, z], height and facing_deg of the hips, and joints, reach, half = "upper" or "lower", or root_only
    = true or "place" where not all of it counts; or a drawing (a CSV of joint,x,y) and view_deg
    (docs/guides/keyframes.md)."""
    out: options.OutFile
    """Where the motion goes: as long as IN, or until the last key."""
    keyframes: Annotated[str | None, arg(metavar="F,F,...")] = None
    """Keyframes of a motion file, or seconds as in 1.5s; the first and the last one are whole poses."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Keys between the first and the last give only the positions of these hands or feet: canonical names or the rig's
    own."""
    root_only: bool = False
    """Keys between the first and the last give only the position and the facing of the hips."""
    suggest_timing: bool = False
    """Print how many frames mocap takes from each whole pose to the next, beside what is given; the motion keeps the
    given timing."""
    timing: options.MaybeName = None
    """The file or run folder of a trained keyframe timing for --suggest-timing; the bundled one if not given."""
    prior: options.MaybeName = None
    """A density whose likelihood joins the MAP stage: a bundled one, a file or a run folder; `auto` takes, window by
    window, the bundled one under which the motion is likelier."""
    variations: options.Count = 1
    """Number of different motions, as OUT_000.bvh, OUT_001.bvh, ...: the first is what a single one would be. With
    --dna the others are in one of its styles each, and when all were had by some of the poses of one; with --method
    tweener alone each is of a class; with --method stitcher they are its draws. Else they are rollouts of densities
    (--prior, or auto), steered from key to key."""
    seed: options.Count = 0
    """Seed of everything that is sampled; the first variations do not depend on their number."""
    report: options.MaybeFile = None
    """JSON with the keys, the errors at them, contacts, ledger, measures, compute and suggested timing."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif, .webp or .png. Of variations a .png: a row of
    stills of each, under the name of its style."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: keys too close in time, limbs out of reach."""
    quiet: bool = False
    """No summary and no progress bar."""


def run(command: Tween) -> int:
    """Check everything, make, write, report."""
    request = _read_key_request(command)
    with priors.use_weights(command.weights or (None if request is None else request.weights)):
        return _run_request(command, request)


def _run_request(command: Tween, request: KeyRequest | None) -> int:
    _check(command, [command.source] if request is None else [command.source, *map(Path, request.files)])
    clip = _read_keyframe_clip(command, request)
    dna = read_dna(command)
    models = results.load_models(command, prior=command.prior, dna=dna)
    make = _prepare_tweening(command, clip)
    if command.variations > 1:
        ok = run_variations(command, clip, make, models, dna)
        return NOT_SATISFIED if command.strict and not ok else 0
    intervals = _suggest_timing(command, clip)
    done = make(build_inbetweener(command.method, models), torch.Generator().manual_seed(command.seed))
    outputs.save_motion(done.motion, command.out)
    if command.report is not None:
        report.write_report(_build_report(command, done, clip, intervals), command.report)
    results.film_comparison(clip.motion, done.motion, command.video, rig=clip.rig, quiet=command.quiet)
    if not command.quiet:
        _tell(command, done, clip, intervals)
    return conclude(done.status, strict=command.strict)


def _tell(command: Tween, done: InbetweenSolution, clip: KeyframeClip, intervals: Sequence[KeyInterval]) -> None:
    ms, count = 1000 * done.seconds / done.motion.num_frames, len(clip.keys.frames)
    print(f"{command.out}: {done.motion.num_frames} frames through {count} keys; {ms:.1f} ms a frame")
    for note in (*done.notes, *done.gap_notes):
        print(note)
    if intervals:
        rows = [(i.start, i.stop, i.given, i.suggested, i.reason) for i in intervals]
        print_table(("key", "next", "given", "suggested", "why"), rows, title="frames between keys")


def _suggest_timing(command: Tween, clip: KeyframeClip) -> list[KeyInterval]:
    if not command.suggest_timing:
        return []
    timing = priors.load_keyframe_timing(command.timing or "keyframe-timing")
    return suggest_intervals(clip.motion, clip.keys, timing, clip.rig)


def _is_key_file(command: Tween) -> bool:
    """Return whether the keys are those of a TOML file."""
    return command.source.suffix.lower() == ".toml"


def _read_key_request(command: Tween) -> KeyRequest | None:
    return read_keys(command.source) if _is_key_file(command) else None


def _check(command: Tween, given: Sequence[Path]) -> None:
    """Check the options; the given files are read, so they must not be written."""
    if command.timing is not None and not command.suggest_timing:
        raise RequestError("--timing is what --suggest-timing asks; without that it does nothing")
    if command.joints is not None and command.root_only:
        raise RequestError("--joints and --root-only are two kinds of keys; choose one")
    options = {"--keyframes": command.keyframes, "--joints": command.joints, "--root-only": command.root_only or None}
    unused = [name for name, value in options.items() if value is not None]
    if _is_key_file(command) and unused:
        raise RequestError(f"{unused[0]} is for motion files; {command.source} says itself what its keys are")
    if not _is_key_file(command) and command.keyframes is None:
        raise RequestError("of a motion file, --keyframes says which frames are keys (see mapctl tween --help)")
    check_answers(command, given)
    # Variations are rollouts of a density with every method.
    prior = command.prior if command.variations == 1 else None
    results.check_proposal(command, prior=prior)


def _read_keyframe_clip(command: Tween, request: KeyRequest | None) -> KeyframeClip:
    """Read the motion that holds the keys, the keys, and its rig where it is known."""
    rig = inputs.read_rig(command.rig, command)
    if request is not None:
        return _load_key_file(command, request, rig)
    motion = inputs.read_motion(command.source, rig, quiet=command.quiet)
    frames = [parse_frame(word, fps=float(motion.fps)) for word in (command.keyframes or "").split(",")]
    if len(set(frames)) == 2 and (command.root_only or command.joints is not None):
        name = "--root-only" if command.root_only else "--joints"
        raise RequestError(f"{name} is about keys between the first and the last, and --keyframes has none there")
    limbs = () if command.joints is None else tuple(name.strip() for name in command.joints.split(","))
    return KeyframeClip(motion, Keys.of(frames, limbs=limbs, root_only=command.root_only), rig)


def _load_key_file(command: Tween, request: KeyRequest, rig: Rig | None) -> KeyframeClip:
    try:
        clip = build_keyframe_clip(request, rig, None if command.quiet else inputs.print_doubts)
    except RequestError as error:
        raise FileFormatError(command.source, str(error)) from error
    weight_sets.note_licence(str(command.source), clip.motion.licence)
    return clip


def _prepare_tweening(command: Tween, clip: KeyframeClip) -> Tweening:
    """Bind everything but the in-betweener and the generator."""
    densities = priors.load_choice(command.prior)
    settings = InfillSettings(finish=not command.no_finish)

    def make(inbetweener: Inbetweener, generator: torch.Generator) -> InbetweenSolution:
        return tween(
            clip.motion,
            clip.keys,
            inbetweener,
            settings=settings,
            densities=densities,
            rig=clip.rig,
            generator=generator,
        )

    return make


def _build_report(
    command: Tween, done: InbetweenSolution, clip: KeyframeClip, intervals: Sequence[KeyInterval]
) -> dict[str, Any]:
    errors = measure_keyframe_errors(done.motion, clip.motion, clip.keys, clip.rig)
    timing = {"key_timing": [interval.summary() for interval in intervals]} if command.suggest_timing else {}
    return results.build_report("tween", command, done) | {"keys": errors, **timing}


_MAX_ANSWERS = 1000
_IN_STYLE = " in the style of "


def number_paths(path: Path, count: int) -> list[Path]:
    """Number the paths of variations: walk_000.bvh, walk_001.bvh, ... for walk.bvh."""
    return [path.with_name(f"{path.stem}_{number:03d}{path.suffix}") for number in range(count)]


def check_answers(command: Tween, given: Sequence[Path]) -> None:
    """Raise RequestError for options that exclude several motions, and files that cannot be written."""
    options.check_seed(command.seed)
    if not 1 <= command.variations <= _MAX_ANSWERS:
        raise RequestError(f"--variations must be 1 to {_MAX_ANSWERS}, got {command.variations}")
    if command.variations > 1 and command.method == "slerp":
        raise RequestError("--method slerp knows one answer only; leave --variations out")
    if command.variations == 1:
        # Of the stitcher, whose draws are asked for by number, one answer is the calm one whatever the seed.
        if command.seed and command.method not in ("rollouts", "stitcher"):
            raise RequestError("--seed is of what is drawn, and nothing is; ask for --variations or --method rollouts")
        results.check_destinations(command.out, command.video, command.report, given=given)
        return
    if command.suggest_timing:
        raise RequestError("--suggest-timing tells of one answer; leave --variations out")
    if command.video is not None and command.video.suffix.lower() != ".png":
        raise RequestError("--video of several answers is a .png of stills; film OUT_000 by `mapctl render`")
    first, *others = number_paths(command.out, command.variations)
    results.check_destinations(first, command.video, *others, command.report, given=given)


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
        outputs.save_motion(one.solution.motion, file)
    if command.report is not None:
        report.write_report(_report_variations(command, clip, found, files), command.report)
    if command.video is not None:
        draw_strips_to(
            [(_name_row(one.solution, file), to_canonical(one.solution.motion, clip.rig)[0]) for one, file in rows],
            command.video,
        )
    if not command.quiet:
        _tell_variations(found, files, len(clip.keys.frames))
    return all(one.solution.status.ok for one in found.each)


def _draw_stitches(command: Tween, first: Inbetweener) -> Source | None:
    """Draw from the stitcher, if it is one that was asked for."""
    if not isinstance(first, StitchedInbetweener) or not isinstance(first.stitcher, Stitcher):
        return None
    drawing, longest = first.stitcher.drawing(command.seed), first.stitcher.longest
    return Source(
        lambda number, draws: replace(first, stitcher=drawing.numbered(number)),
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

    return Source(draw, "room for a style")


def _tell_variations(found: Variations, files: Sequence[Path], keys: int) -> None:
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
