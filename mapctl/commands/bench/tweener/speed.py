"""Table 3: seconds of one core, from the rig's keys to the rig's motion."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

import priors
from controllers.benchmarks.shared.held_out import find_held_out
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.processing_time import Stopwatch, TimedPath, benchmark_processing_time
from controllers.benchmarks.tweener.spliced_keys import KeySequence
from mapctl import formats, retarget
from mapctl.commands.bench import Tweener
from mapctl.commands.bench.tweener.keys import load_kinds
from mapctl.commands.bench.tweener.sequences import EVEN_GAPS, HeldOutClips
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.inbetweening import PositionImage
from mapctl.protocols import Inbetweener
from priors.tweening.generator import GeneratedPoses, GeneratorNetwork

_SIZES = (4, 2, 1)  # of --frames the parts that are measured, and twice of it


class _TimedNetwork(GeneratorNetwork):
    """A generator on a stopwatch, as `poses`."""

    def __init__(self, network: GeneratorNetwork, stopwatch: Stopwatch):
        super().__init__(network.config)
        self.load_state_dict(network.state_dict())
        self.eval().requires_grad_(False)
        self.stopwatch = stopwatch

    def forward(self, image: PositionImage, style: Float[Tensor, "batch style"]) -> GeneratedPoses:
        """Make poses as the other does."""
        with self.stopwatch.measure("poses"):
            return super().forward(image, style)


def measure(table: Tweener) -> dict[str, list[Row]]:
    """Measure sequences of a quarter, a half, one and two times --frames, on the rig of the first held-out clip."""
    tweener = priors.load_tweener(table.tweener, table.path)

    def make(stopwatch: Stopwatch) -> Inbetweener:
        timed = _TimedNetwork(tweener.network, stopwatch)
        return replace(tweener, network=timed, path=TimedPath(tweener.path, stopwatch))

    held = HeldOutClips(load_kinds(table))
    first = find_held_out(table.data, tweener.card.data.get("held_out", {}))[0]
    rig = retarget.identify_rig(formats.load(first).skeleton)
    sizes = [table.frames // part for part in _SIZES] + [2 * table.frames]
    drawn = [next(held.draw(1, frames, EVEN_GAPS, seed=0)) for frames in sizes]
    shown: list[KeySequence] = [replace(each, motion=retarget.from_canonical(each.motion, rig)) for each in drawn]
    with show_progress("speed") as progress:
        rows = benchmark_processing_time(shown, make, finish=not table.raw, progress=progress)
    return {"speed": rows}
