"""`mapctl generate`: motion sampled from a prior, of any length."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial, reduce
from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import arg

import priors
from controllers.generation.foot_cleanup import FootCleanupSettings
from controllers.generation.generate import SIGMA_PLANTED, GenerateSettings, sample_stratified_starts, stream
from mapctl import formats
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics.gait import PACES, label_pace
from mapctl.motion import Motion
from mapctl.retarget import to_canonical


@dataclass(frozen=True)
class Generate(ModelCommand, options.ReadOptions):
    """Motion sampled from a prior, of any length: OUT/generated_000.bvh, generated_001.bvh, ..."""

    out: options.OutFolder
    """Folder for the clips; created if it does not exist."""
    seconds: options.Number
    """Length of each clip."""
    count: options.Count = 1
    """Number of clips."""
    seed: options.Count = 0
    """Seed of everything random; each clip gets its own seed from it. Initial states are stratified over the data's
    speeds."""
    temperature: options.Number = 1.0
    """Temperature of the samples, 0 to 2: 0 is the prior's mean, 1 the prior itself."""
    start: Annotated[Path | None, arg(metavar="CLIP")] = None
    """A clip to continue from; initial states are sampled if not given."""
    prior: options.Prior = "locomotion"
    style: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Gait, style and pace by the names of the prior's data, such as run or elderly,walk; `none` leaves the prior
    unconditioned. If not given, gait and style are those of the clip that it begins from. Unless a pace is named, a
    prior that is conditioned on paces is given one after the other."""
    refiner: options.MaybeName = None
    """A refiner between samples and foot clean-up: a bundled one, the file or run folder of a trained one, or auto, the
    prior's own. None if not given: a classifier separates refined samples from mocap more often."""
    no_footing: bool = False
    """Leave out the foot clean-up. Without a refiner, each frame is then sampled given that toes stand where its
    contact bits are 1: feet slide about as mocap's do, and it is faster."""
    rig: options.BodyRig = "canonical"
    to: Annotated[str, arg(metavar=".bvh|.npz|.glb|...")] = ".bvh"
    """Format of the clips by its ending; a character of --rig is written with them where the ending is its own.
    Only .bvh is written as it is sampled, the others take memory for the whole clip."""
    quiet: options.Quiet = False


_MAX_CLIPS = 10_000


def run(command: Generate) -> int:
    """Check everything, then write clip after clip; clips that are finished stay if it is interrupted."""
    frames, settings, clip = inputs.count_frames(command.seconds), *_check_settings(command)
    prior = priors.load(command.prior)
    if command.style not in (None, "none"):
        names = [name.strip() for name in command.style.split(",")]
        prior = prior.conditioned_on(names)
        settings = replace(settings, vary_paces=not {*names} & {*PACES, *map(label_pace, PACES)})
    refiner = None if command.refiner is None else priors.refiner_of(command.prior, command.refiner)
    character = inputs.read_character(command.rig, command)
    if settings.foot_cleanup is not None:
        footing = replace(settings.foot_cleanup.footing, rest_height=character.toe_rest_height)
        settings = replace(settings, foot_cleanup=replace(settings.foot_cleanup, footing=footing))
    draw = partial(
        stream, prior, seconds=command.seconds, start_clip=clip, refiner=refiner, skeleton=character.skeleton
    )
    starts = sample_stratified_starts(prior, command.count, torch.Generator().manual_seed(command.seed))
    # A seed for each clip; the first ones do not depend on the count.
    seeds = torch.randint(2**62, (command.count,), generator=torch.Generator().manual_seed(command.seed)).tolist()
    with outputs.make_folder(command.out) as folder, outputs.explain_progress(command.count, "clips") as finished:
        for number, seed in enumerate(seeds):
            own = replace(settings, start=starts[number])
            pieces = draw(generator=torch.Generator().manual_seed(seed), settings=own)
            motions = (outputs.mark_motion(character.on_rig(piece.motion)) for piece in pieces)
            _write(command, motions, folder / f"generated_{number:03d}{command.to}", frames)
            finished(number + 1)
    return 0


def _check_settings(command: Generate) -> tuple[GenerateSettings, Motion | None]:
    options.check_seed(command.seed)
    if not 1 <= command.count <= _MAX_CLIPS:
        raise RequestError(f"the count must be 1 to {_MAX_CLIPS}, got {command.count}")
    outputs.check_folder(command.out)
    formats.check_ending(command.out / f"clip{command.to}")
    finishing = None if command.no_footing else FootCleanupSettings()
    planted = SIGMA_PLANTED if command.no_footing and command.refiner is None else None
    settings = GenerateSettings(
        command.temperature,
        condition_on_start=command.style is None,
        vary_paces=command.style != "none",
        foot_cleanup=finishing,
        sigma_planted=planted,
    )
    if command.start is None:
        return settings, None
    clip, rig = inputs.read_clip(command.start, command)
    return settings, clip if rig is None else to_canonical(clip, rig)[0]


def _write(command: Generate, pieces: Iterable[Motion], path: Path, frames: int) -> None:
    began, done = time.perf_counter(), list[Motion]()
    with outputs.show_progress(path.name, quiet=command.quiet) as progress:
        for piece in pieces:
            done.append(piece)
            if progress is not None:
                progress(sum(one.num_frames for one in done), frames)
        reduce(Motion.join, done).save(path)
    if not command.quiet:
        rate = frames / (time.perf_counter() - began)
        print(f"{path}: {frames} frames, {frames / PRIOR_FPS:.1f} s, drawn at {rate:.0f} frames a second")
