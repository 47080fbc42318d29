"""`mapctl tween`: a motion through keyframes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import priors
from controllers.inbetweening.keyframe_poses import KeyframeClip, build_keyframe_clip
from controllers.inbetweening.keyframe_timing import KeyInterval, suggest_intervals
from controllers.inbetweening.keyframes import check_effectors
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import build_inbetweener
from controllers.inbetweening.solution import InbetweenSolution
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from controllers.inbetweening.variations import Tweening
from mapctl import report
from mapctl.commands.shared import exit_status, inputs, licensing, results
from mapctl.commands.shared.exit_status import conclude
from mapctl.commands.shared.frame_syntax import parse_frame
from mapctl.commands.shared.style import read_dna
from mapctl.commands.shared.tables import print_table
from mapctl.commands.tween import Tween, variations
from mapctl.errors import FileFormatError, RequestError
from mapctl.intent.keyframe_toml import KeyRequest, read_keys
from mapctl.intent.keyframes import Keys
from mapctl.protocols import Inbetweener
from mapctl.retarget.rigs import Rig
from priors import licences


def run(command: Tween) -> int:
    """Check everything, make, write, report."""
    request = _read_key_request(command)
    with priors.use_weights(command.weights or (None if request is None else request.weights)):
        return _run_request(command, request)


def _run_request(command: Tween, request: KeyRequest | None) -> int:
    _check(command, [command.source] if request is None else [command.source, *map(Path, request.files)])
    clip = _read_keyframe_clip(command, request)
    dna = read_dna(command.dna, command.method)
    models = results.load_models(command.inbetweener, command.prior, command.path, dna, command.stitcher)
    make = _prepare_tweening(command, clip)
    if command.variations > 1:
        ok = variations.run_variations(command, clip, make, models, dna)
        return exit_status.NOT_SATISFIED if command.strict and not ok else 0
    intervals = _suggest_timing(command, clip)
    if command.best_of > 1:
        done = variations.tween_lowest_energy(command, make, models)
    else:
        done = make(build_inbetweener(command.method, models), torch.Generator().manual_seed(command.seed))
    licensing.save_motion(done.motion, command.out)
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
    if command.path is not None and not results.takes_path(command.method, command.inbetweener):
        raise RequestError("--path predicts where the hips go for --method tweener; leave it out")
    variations.check_answers(command, given)
    # Variations are rollouts of a density with every method.
    prior = command.prior if command.variations == command.best_of == 1 else None
    results.check_method(
        command.method,
        finish=not command.no_finish,
        prior=prior,
        inbetweener=command.inbetweener,
        stitcher=command.stitcher,
    )


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
    if limbs:  # also where there is no key between the first and the last
        check_effectors(limbs, motion, rig)
    return KeyframeClip(motion, Keys.of(frames, limbs=limbs, root_only=command.root_only), rig)


def _load_key_file(command: Tween, request: KeyRequest, rig: Rig | None) -> KeyframeClip:
    try:
        clip = build_keyframe_clip(request, rig, None if command.quiet else inputs.print_doubts)
    except RequestError as error:
        raise FileFormatError(command.source, str(error)) from error
    licences.note_licence(str(command.source), clip.motion.licence)
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
