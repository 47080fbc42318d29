"""`mapctl chain`: one long motion through pieces of many clips."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import arg

from mapctl.commands.shared import options, results
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import RequestError


@dataclass(frozen=True)
class Chain:
    """One long motion through short pieces of many clips, the gaps between them filled in; on the first clip's rig."""

    clips: tyro.conf.Positional[Annotated[tuple[Path, ...], arg(metavar="CLIP CLIP ...")]]
    """Motion files, of any known rigs."""
    out: options.OutFile
    """Where the motion goes, at 30 frames a second."""
    piece: options.Count = 40
    """Frames that are taken from the middle of every clip."""
    gap: Annotated[str, arg(metavar="A:B")] = "50:100"
    """Frames between two pieces: drawn from A to B."""
    seed: options.Count = 0
    """Of the gaps' lengths."""
    method: Annotated[Literal["infiller", "map", "linear"], arg(metavar="infiller|map|linear")] = "map"
    """map: the infiller proposes, the MAP stage finishes. infiller: its proposal on rigid bones. linear: none of it."""
    infiller: options.MaybeName = None
    """The file or run folder of a trained infiller; the bundled one if not given."""
    video: options.MaybeFile = None
    """Film of the motion: .mp4, .gif or .png."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, chain, write, tell."""
        use_single_thread()
        options.check_seed(self.seed)
        from mapctl import formats

        results.check_method(self.method, infiller=self.infiller)
        results.check_destinations(self.out, self.video, given=self.clips)
        import torch

        import priors
        from controllers.inbetweening.chain import ChainSettings, chain
        from controllers.inbetweening.pipeline import InfillSettings

        settings = ChainSettings(piece=self.piece, gap=self._parse_gap())
        infiller = None if self.method == "linear" else priors.load_infiller(self.infiller or "infiller")
        done = chain(
            [options.read_motion(path, None) for path in self.clips],
            infiller,
            settings=settings,
            filling=InfillSettings(method=self.method),
            rollout_densities=priors.load_choice("auto") if self.method == "map" else (),
            generator=torch.Generator().manual_seed(self.seed),
        )
        formats.save(done.motion, self.out)
        if self.video is not None:
            from mapctl.retarget import to_canonical
            from mapctl.runtime.progress import show_progress
            from scenes.film import film

            with show_progress("filming", quiet=self.quiet) as progress:
                film([(to_canonical(done.motion)[0], None)], self.video, progress=progress)
        if not self.quiet:
            filled = int(done.lost.frames.sum())
            print(
                f"{self.out}: {done.motion.num_frames} frames, {filled} of them filled in between {len(self.clips)}"
                f" clips; {1000 * done.seconds / max(1, filled):.1f} ms a filled frame"
            )
            for note in (*done.notes, *done.gap_notes):
                print(note)
        return 0

    def _parse_gap(self) -> tuple[int, int]:
        low, colon, high = self.gap.partition(":")
        if not (colon and low.isdecimal() and high.isdecimal()):
            raise RequestError(f"--gap is A:B, frames as in 50:100; got {self.gap!r}")
        return int(low), int(high)
