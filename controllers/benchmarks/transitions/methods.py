"""What the benchmark of transitions compares: ways to fill a gap once, and ways to fill it several times."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from controllers.common.score import score
from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.refine import INFILL_REFINEMENT
from mapctl.contacts import detect_contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.retrieval import MotionCollection, bend_to_ends
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES


@dataclass(frozen=True, eq=False)
class Filled:
    """A motion whose gap was filled."""

    motion: Motion
    """The motion."""
    apart: float | None = None
    """Mean distance of joints, metres, at which two sides met, where there were any."""


Method = Callable[[Motion, int, int], Filled]
"""Fills frames start to stop of a canonical motion, whose values there are the truth and must not be looked at."""
Sampler = Callable[[Motion, int, int, int], Sequence[Filled]]
"""Fills them in as many ways as are asked for."""
Energy = Callable[[Motion], float]
"""Energy of a motion, nats a frame."""


def of_inbetweener(inbetweener: Inbetweener, densities: Sequence[Density] = (), *, finish: bool = True) -> Method:
    """Return the method of an in-betweener, raw or finished by MAP, as `mapctl infill` runs it."""

    def method(part: Motion, start: int, stop: int) -> Filled:
        free = torch.zeros(part.num_frames, dtype=torch.bool)
        free[start:stop] = True
        missing = MissingMask.of_frames(free, part.num_joints)
        done = fill(part, missing, inbetweener, settings=InfillSettings(finish=finish), densities=densities)
        apart = [source.apart for source in done.sources if source.apart is not None]
        return Filled(done.motion, max(apart, default=None))

    return method


def of_draws(number: Callable[[int], Inbetweener], *, finish: bool = False) -> Sampler:
    """Return the sampler of an in-betweener that proposes its draws by number."""

    def sampler(part: Motion, start: int, stop: int, count: int) -> Sequence[Filled]:
        return [of_inbetweener(number(each), finish=finish)(part, start, stop) for each in range(count)]

    return sampler


def of_density(density: Density) -> Energy:
    """Return the energy by which `mapctl tween --best-of` picks: likelihood, footing, clearance, support and jerk."""

    def measure(motion: Motion) -> float:
        planted = detect_contacts(motion.joint_positions()[:, CANONICAL.indices(TOES)], PRIOR_FPS)
        ledger = score(motion, planted, density, INFILL_REFINEMENT)
        return sum(float(entry.energy.mean()) for entry in ledger.entries)

    return measure


def hold_last_pose(part: Motion, start: int, stop: int) -> Filled:
    """Hold the pose before the gap: zero velocity."""
    source = torch.arange(part.num_frames)
    source[start:stop] = start - 1
    return Filled(replace(part, root_position=part.root_position[source], local_quat_xyzw=part.local_quat_xyzw[source]))


def of_retrieval(collection: MotionCollection) -> Method:
    """Return the method that takes the nearest window of other clips, its ends bent."""
    sampler = draw_retrieved(collection)

    def method(part: Motion, start: int, stop: int) -> Filled:
        return sampler(part, start, stop, 1)[0]

    return method


def draw_retrieved(collection: MotionCollection) -> Sampler:
    """Return the sampler that takes the nearest windows of as many other clips, their ends bent."""

    def sampler(part: Motion, start: int, stop: int, count: int) -> Sequence[Filled]:
        first, last = part.slice(start - 1, start), part.slice(stop, stop + 1)
        answers = []
        for window in collection.find_nearest(first, last, stop - start + 1, count):
            found = bend_to_ends(window, first, last)
            root, quats = part.root_position.clone(), part.local_quat_xyzw.clone()
            root[start:stop], quats[start:stop] = found.root_position[1:-1], found.local_quat_xyzw[1:-1]
            answers.append(Filled(replace(part, root_position=root, local_quat_xyzw=quats)))
        return answers

    return sampler
