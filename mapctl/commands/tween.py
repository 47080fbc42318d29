"""`mapctl tween`: a motion through keyframes."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import arg

import priors
from controllers.inbetweening.keyframes import KeyframeClip, build_keyframe_clip, suggest_intervals
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, InbetweenSolution
from controllers.inbetweening.proposers import (
    AutoInbetweener,
    ModelLoaders,
    RolloutInbetweener,
    StitchedInbetweener,
    build_inbetweener,
)
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from controllers.inbetweening.variations import Source, Tweening, sample_variations
from mapctl.commands.shared import inputs, options, outputs, results
from mapctl.commands.shared.command import NOT_SATISFIED, ModelCommand, conclude
from mapctl.errors import FileFormatError, RequestError
from mapctl.ground import Ground
from mapctl.intent.keyframes import KeyRequest, Keys, read_keys
from mapctl.protocols import Inbetweener
from mapctl.report import write_report
from mapctl.retarget import to_canonical
from priors import weight_sets
from priors.stitcher import Stitcher
from priors.tweener import Tweener, draw_style
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
    """Output file: as long as IN, or until the last key."""
    keyframes: Annotated[str | None, arg(metavar="F,F,...")] = None
    """Keyframes of a motion file, or seconds as in 1.5s; the first and the last one are whole poses."""
    joints: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Keys between the first and the last give only the positions of these hands or feet: canonical names or the rig's
    own."""
    root_only: bool = False
    """Keys between the first and the last give only the position and the facing of the hips."""
    ground: options.MaybeFile = None
    """TOML file of the ground that the keys, whole poses, stand on, where it is not flat (see `mapctl follow --help`).
    """
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
    quiet: options.Quiet = False


_IN_STYLE = " in the style of "


def run(command: Tween) -> int:
    request = read_keys(command.source) if command.source.suffix.lower() == ".toml" else None
    with priors.use_weights(command.weights or (request and request.weights)):
        return _run_request(command, request)


def _run_request(command: Tween, request: KeyRequest | None) -> int:
    _check(command, request)
    clip, dna = _read_keyframe_clip(command, request), results.read_dna(command)
    models = results.load_models(command, prior=command.prior, dna=dna)
    refinement, densities = None if command.no_refine else INFILL_REFINEMENT, priors.load_choice(command.prior)
    ground = None if command.ground is None else Ground.read(command.ground)

    def make(by: Inbetweener, generator: torch.Generator) -> InbetweenSolution:
        options = {"refinement": refinement, "densities": densities, "rig": clip.rig, "generator": generator}
        return tween(clip.motion, clip.keys, by, ground=ground, **options)

    if command.variations > 1:
        ok = _run_variations(command, clip, make, models, dna)
        return NOT_SATISFIED if command.strict and not ok else 0
    intervals = []
    if command.suggest_timing:
        timing = priors.load_keyframe_timing(command.timing or "keyframe-timing")
        intervals = suggest_intervals(clip.motion, clip.keys, timing.estimate_seconds, clip.rig)
    generator = torch.Generator().manual_seed(command.seed)
    done = make(build_inbetweener(command.method, models), generator)
    more = {"keys": measure_keyframe_errors(done.motion, clip.motion, clip.keys, clip.rig)}
    if command.suggest_timing:
        more["key_timing"] = [interval.summary() for interval in intervals]
    results.write_result("tween", command, done, clip.motion, rig=clip.rig, more=more)
    if not command.quiet:
        ms, count = 1000 * done.seconds / done.motion.num_frames, len(clip.keys.frames)
        print(f"{command.out}: {done.motion.num_frames} frames through {count} keys; {ms:.1f} ms a frame")
        footing = () if done.footing is None else (f"ground: {done.footing.text}",)
        print("".join(f"{note}\n" for note in (*footing, *done.notes, *done.gap_notes)), end="")
        if intervals:
            rows = [(i.start, i.stop, i.given, i.suggested, i.reason) for i in intervals]
            outputs.print_table(("key", "next", "given", "suggested", "why"), rows, title="frames between keys")
    return conclude(done.status, strict=command.strict)


def _check(command: Tween, request: KeyRequest | None) -> None:
    """Check the options; the files that are read must not be written."""
    options.check_seed(command.seed)
    if command.timing is not None and not command.suggest_timing:
        raise RequestError("--timing is what --suggest-timing asks; without that it does nothing")
    if command.joints is not None and command.root_only:
        raise RequestError("--joints and --root-only are two kinds of keys; choose one")
    kinds = {"--keyframes": command.keyframes, "--joints": command.joints, "--root-only": command.root_only or None}
    unused = [name for name, value in kinds.items() if value is not None]
    if request is not None and unused:
        raise RequestError(f"{unused[0]} is for motion files; {command.source} holds its own keys")
    if request is None and command.keyframes is None:
        raise RequestError("a motion file needs --keyframes, its frames that are keys (see mapctl tween --help)")
    options.check_variations(command.variations)
    given, several = [command.source, *map(Path, () if request is None else request.files)], command.variations > 1
    # Variations are rollouts of a density with every method.
    results.check_proposal(command, prior=None if several else command.prior)
    if not several:
        # Of the stitcher, whose draws are requested by number, one answer is the calm one whatever the seed.
        if command.seed and command.method not in ("rollouts", "stitcher"):
            raise RequestError("--seed is of what is drawn, and nothing is; ask for --variations or --method rollouts")
        results.check_destinations(command.out, command.video, command.report, given=given)
        return
    if command.ground is not None:
        raise RequestError("--ground is for one answer; leave --variations out")
    if command.method == "slerp":
        raise RequestError("--method slerp has one answer only; leave --variations out")
    if command.suggest_timing:
        raise RequestError("--suggest-timing is for one answer; leave --variations out")
    if command.video is not None and command.video.suffix.lower() != ".png":
        raise RequestError("--video of several answers is a .png of stills; film OUT_000 by `mapctl render`")
    first, *others = (outputs.number_path(command.out, number) for number in range(command.variations))
    results.check_destinations(first, command.video, *others, command.report, given=given)


def _read_keyframe_clip(command: Tween, request: KeyRequest | None) -> KeyframeClip:
    """Read the motion that holds the keys, the keys, and its rig where it is known."""
    rig = inputs.read_rig(command.rig, command)
    if request is not None:
        try:
            clip = build_keyframe_clip(request, rig, None if command.quiet else inputs.print_doubts)
        except RequestError as error:
            raise FileFormatError(command.source, str(error)) from error
        weight_sets.note_licence(str(command.source), clip.motion.licence)
        return clip
    motion = inputs.read_motion(command.source, rig, quiet=command.quiet)
    frames = [options.parse_frame(word, fps=float(motion.fps)) for word in (command.keyframes or "").split(",")]
    if len(set(frames)) == 2 and (command.root_only or command.joints is not None):
        name = "--root-only" if command.root_only else "--joints"
        raise RequestError(f"{name} is about keys between the first and the last, and --keyframes has none there")
    limbs = () if command.joints is None else tuple(name.strip() for name in command.joints.split(","))
    return KeyframeClip(motion, Keys.of(frames, limbs=limbs, root_only=command.root_only), rig)


def _run_variations(
    command: Tween, clip: KeyframeClip, make: Tweening, models: ModelLoaders, dna: results.Examples
) -> bool:
    """Generate, write, report each file with its energy. Return whether all that was requested holds."""
    with outputs.show_progress("variations", quiet=command.quiet) as progress:
        first = build_inbetweener(command.method, models)
        source = _choose_source(command, first, dna)
        # Where others are drawn from the density only gives energies.
        rollouts = RolloutInbetweener(models.densities(), first if source else models.network("rollouts"))
        found = sample_variations(
            make,
            first,
            rollouts,
            command.variations,
            generator=torch.Generator().manual_seed(command.seed),
            source=source,
            progress=progress,
        )
    keys, rows, strips, lines = len(clip.keys.frames), [], [], []
    for number, one in enumerate(found.each):
        solution, motion, file = one.solution, one.solution.motion, outputs.number_path(command.out, number)
        outputs.save_motion(motion, file)
        styles = [by for by in dict.fromkeys(part.by for part in solution.sources) if _IN_STYLE in by]
        if command.report is not None:
            errors = measure_keyframe_errors(motion, clip.motion, clip.keys, clip.rig)
            own = {"file": str(file), "energy_nats": one.energy, "keys": errors}
            rows.append(own | results.build_report("tween", command, solution))
        if command.video is not None:
            name = styles[0].partition(_IN_STYLE)[2] if styles else file.stem
            strips.append((name, to_canonical(motion, clip.rig)[0]))
        cost = f"{1000 * solution.seconds / motion.num_frames:.1f} ms a frame"
        energy = f"energy {one.energy:.1f} nats a frame"
        lines.append(f"{file}: {motion.num_frames} frames through {keys} keys; {energy}; {'; '.join([cost, *styles])}")
    if command.report is not None:
        shared = {key: rows[0][key] for key in ("mapctl", "request", "versions")}
        each = [{key: value for key, value in row.items() if key not in shared} for row in rows]
        write_report({**shared, "diversity": found.diversity._asdict(), "variations": each}, command.report)
    if command.video is not None:
        draw_strips_to(strips, command.video)
    if not command.quiet:
        apart, done = found.diversity, found.each[0].solution
        lines.append(
            f"{len(lines)} variations, on average {apart.world_cm:.1f} cm apart in the world and"
            f" {apart.root_aligned_cm:.1f} cm seen from the hips"
        )
        print("\n".join([*lines, *done.notes, *done.gap_notes]))
    return all(one.solution.status.ok for one in found.each)


def _choose_source(command: Tween, first: Inbetweener, dna: results.Examples) -> Source | None:
    """Choose what variations are drawn from: the stitcher, if it is one that was requested, or styles, of those that
    --dna names or of the classes that the tweener has; None for methods whose variations are rollouts. RequestError
    where there is nothing to draw from."""
    if isinstance(first, StitchedInbetweener) and isinstance(first.stitcher, Stitcher):
        stitcher = first.stitcher
        return Source(
            lambda number, draws: replace(first, stitcher=stitcher.drawing(command.seed, number)),
            f"whole poses with 1 to {stitcher.longest} frames between them",
        )
    tweener = first.tweener if isinstance(first, AutoInbetweener) else first
    if not isinstance(tweener, Tweener) or (not dna and command.method != "tweener"):
        return None
    styles = results.find_styles(tweener, dna) or list(tweener.classes.values())
    if not styles:
        raise RequestError(f"{tweener.name} has no classes of motion to draw variations from; name clips by --dna")
    order = torch.randperm(len(styles), generator=torch.Generator().manual_seed(command.seed)).tolist()

    def draw(number: int, draws: torch.Generator) -> Inbetweener:
        style = draw_style(styles, number, tweener.encode_style, order=order, generator=draws)
        return results.restyle(first, style)

    return Source(draw, "room for a style")
