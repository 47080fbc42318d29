"""`mapctl generate`: motion drawn from a prior, of any length."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import character, options, outputs
from mapctl.commands.shared.resumption import explain_progress
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError
from mapctl.runtime.progress import show_progress

if TYPE_CHECKING:
    from controllers.generation.generate import GenerateSettings
    from mapctl.motion import Motion

_MAX_CLIPS = 10_000


@dataclass(frozen=True)
class Generate:
    """Motion drawn from a prior, of any length: OUT/generated_000.bvh, generated_001.bvh, ..."""

    out: options.OutFolder
    """Folder for the clips; made if it is not there."""
    seconds: options.Number
    """Length of each clip."""
    count: options.Count = 1
    """How many clips."""
    seed: options.Count = 0
    """Of everything random; each clip draws its own seed from it. Their starts are spread over the data's speeds."""
    temperature: options.Number = 1.0
    """Spread of the draws, 0 to 2: 0 is the prior's mean, 1 the prior itself."""
    start: Annotated[str | None, arg(metavar="CLIP|INDEX")] = None
    """A clip (.bvh, .npz, .amc) to go on from, or the number of a start of the prior for all; drawn if not given."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    style: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Gait and style by the names of the prior's data, such as run or elderly,walk; `none` leaves the prior to itself.
    If not given, motion goes on as the clip does that it begins from."""
    refiner: options.Name = "auto"
    """A bundled refiner, or the file or run folder of a trained one, to go before the footing pass. auto: the prior's
    own where there is no footing pass, and none before one, which measures better alone."""
    no_footing: bool = False
    """Leave out the pass that makes planted feet stand: many times faster, with the refiner's feet."""
    no_refine: bool = False
    """Leave the draws as they are: no refiner, and no pass that makes planted feet stand."""
    rig: character.OutRig = "canonical"
    """Whose body moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    quiet: bool = False
    """No lines on the clips and no progress bar."""

    def run(self) -> int:
        """Check everything, then write clip after clip; clips that are finished stay if it is interrupted."""
        use_single_thread()
        frames, settings, clip = options.count_frames(self.seconds), *self._check_settings()
        import torch

        import priors
        from controllers.generation.generate import sample_stratified_starts, stream

        prior = priors.load(self.prior)
        if self.style not in (None, "none"):
            prior = prior.conditioned_on([name.strip() for name in self.style.split(",")])
        wanted = self.refiner != "auto" or (self.no_footing and not self.no_refine)
        refiner = priors.refiner_of(self.prior, self.refiner) if wanted else None
        person = character.read_character(self.rig)
        if settings.foot_cleanup is not None:
            footing = replace(settings.foot_cleanup.footing, rest_height=person.toe_rest_height)
            settings = replace(settings, foot_cleanup=replace(settings.foot_cleanup, footing=footing))
        draw = partial(stream, prior, seconds=self.seconds, start_clip=clip, refiner=refiner, skeleton=person.skeleton)
        starts = sample_stratified_starts(prior, self.count, torch.Generator().manual_seed(self.seed))
        with outputs.make_folder(self.out) as folder, explain_progress(self.count, "clips") as finished:
            for number, seed in enumerate(self._sample_seeds()):
                own = settings if settings.start is not None else replace(settings, start=starts[number])
                pieces = draw(generator=torch.Generator().manual_seed(seed), settings=own)
                self._write(map(person.on_rig, pieces), folder / f"generated_{number:03d}.bvh", frames)
                finished(number + 1)
        return 0

    def _check_settings(self) -> tuple["GenerateSettings", "Motion | None"]:
        from controllers.generation.foot_cleanup import FootCleanupSettings
        from controllers.generation.generate import GenerateSettings

        options.check_seed(self.seed)
        if not 1 <= self.count <= _MAX_CLIPS:
            raise RequestError(f"the count must be 1 to {_MAX_CLIPS}, got {self.count}")
        outputs.check_folder(self.out)
        numbered = self.start is not None and self.start.lstrip("-").isdecimal()
        if self.no_refine and self.refiner != "auto":
            raise RequestError("--refiner and --no-refine exclude each other")
        if self.no_refine and self.no_footing:
            raise RequestError("--no-refine leaves out the footing pass as well; leave --no-footing out")
        finishing = None if self.no_refine or self.no_footing else FootCleanupSettings()
        start = int(self.start) if self.start and numbered else None
        settings = GenerateSettings(self.temperature, start, self.style is None, finishing)
        if self.start is None or numbered:
            return settings, None
        from mapctl import formats

        return settings, formats.load(self.start)

    def _sample_seeds(self) -> list[int]:
        """One for each clip; the first clips are the same however many are asked for."""
        import torch

        draws = torch.Generator().manual_seed(self.seed)
        return torch.randint(2**62, (self.count,), generator=draws).tolist()

    def _write(self, pieces: Iterable["Motion"], path: Path, frames: int) -> None:
        from mapctl.features import PRIOR_FPS
        from mapctl.formats.bvh.stream import open_bvh_stream

        began = time.perf_counter()
        with show_progress(path.name, quiet=self.quiet) as progress, open_bvh_stream(path, frames) as file:
            for piece in pieces:
                file.append(piece)
                if progress is not None:
                    progress(file.written, frames)
        if not self.quiet:
            rate = frames / (time.perf_counter() - began)
            print(f"{path}: {frames} frames, {frames / PRIOR_FPS:.1f} s, drawn at {rate:.0f} frames a second")
