"""What is measured of one gap beside mocap, as sums: errors, how alive it is, its feet, and how keys are missed before
they are made exact.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.common.canonical_clip import CanonicalClip
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.tween import tween
from mapctl import rotations
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Keys
from mapctl.metrics.feet import ToeMeasurements
from mapctl.metrics.liveliness import NOTHING, Liveliness, measure_liveliness, see_from_hips
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import TOE_JOINTS

RawProposal = Callable[[GapQuery], Float[Tensor, "frames joints 3"]]
"""Function that proposes world positions, metres at unit size, that miss keys as the network misses them."""


@dataclass(frozen=True)
class Method:
    """A way to fill gaps."""

    name: str
    """Name in the table."""
    inbetweener: Inbetweener
    """Who proposes."""
    settings: InfillSettings = field(default_factory=InfillSettings)
    """Whether MAP finishes."""
    raw: RawProposal | None = None
    """What it proposes before keys are made exact; None for who meets them, or is not to be asked."""


@dataclass(frozen=True)
class GapSums:
    """Sums over gaps; begin with one without arguments."""

    made: Liveliness = NOTHING
    """Of what was made."""
    true: Liveliness = NOTHING
    """Of mocap."""
    clips: int = 0
    """Gaps that were measured."""
    frames: int = 0
    """Frames of the clips."""
    off_hips: float = 0.0
    """Mean distance of the hips from their true places over the ground, cm."""
    last: float = 0.0
    """Mean distance of joints, seen from the hips, in the gap's last frame, cm."""
    planted: float = 0.0
    """Frames in which a toe is planted, of either."""
    true_planted: float = 0.0
    """The same of mocap."""
    key_jerk: float = 0.0
    """Jerk at the keys around a gap (`measure_key_jerk`)."""
    sliding: float = 0.0
    """Speed of planted toes, cm/s, over these frames."""
    true_sliding: float = 0.0
    """The same of mocap."""
    seconds: float = 0.0
    """Time that filling took."""

    def __add__(self, other: "GapSums") -> "GapSums":
        return GapSums(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    def summarise(self) -> Row:
        """Return means, and ratios of sums."""
        made, true = self.made, self.true
        return {
            "error_cm": made.error / made.count,
            "hips_cm": self.off_hips / self.clips,
            "speed": made.speed / max(true.speed, 1e-9),
            "spread": made.spread / max(true.spread, 1e-9),
            "jerk": made.jerk / max(true.jerk, 1e-9),
            "planted": self.planted / max(self.true_planted, 1e-9),
            "planted_cm_s": self.sliding / self.planted if self.planted else math.nan,
            "mocap_cm_s": self.true_sliding / self.true_planted if self.true_planted else math.nan,
            "key_jerk": self.key_jerk / self.clips,
            "ms_frame": 1000 * self.seconds / self.frames,
        }


def measure_gap(clip: Motion, method: Method, known: Bool[Tensor, " frames"]) -> GapSums:
    """Measure what a method makes of the frames that are not known, of a canonical clip at PRIOR_FPS."""
    keys = Keys(tuple(known.nonzero()[:, 0].tolist()))
    done = tween(clip, keys, method.inbetweener, settings=method.settings)
    return compare_with_mocap(done.motion, clip, ~known, seconds=done.seconds)


def compare_with_mocap(
    motion: Motion, clip: Motion, inside: Bool[Tensor, " frames"], *, seconds: float = 0.0
) -> GapSums:
    """Measure a motion that was made in so many seconds beside mocap of the same frames, errors and liveliness in the
    frames that are inside gaps."""
    true, made = _see(clip), _see(motion)
    off = (motion.root_position - clip.root_position)[inside][:, ::2].norm(dim=-1)
    last = (made - true)[inside][-1].norm(dim=-1)
    ours, theirs = (
        ToeMeasurements.of(each.joint_positions()[:, list(TOE_JOINTS)], float(each.fps)) for each in (motion, clip)
    )
    lost = inside.nonzero()[:, 0].tolist()
    return GapSums(
        made=measure_liveliness(made, true, inside),
        true=measure_liveliness(true, true, inside),
        clips=1,
        frames=clip.num_frames,
        off_hips=100 * float(off.mean()),
        last=100 * float(last.mean()),
        planted=float(ours.planted[1:].sum()),
        true_planted=float(theirs.planted[1:].sum()),
        sliding=100 * float(ours.speed[ours.planted[1:]].sum()),
        true_sliding=100 * float(theirs.speed[theirs.planted[1:]].sum()),
        key_jerk=measure_key_jerk(motion, clip, (lost[0], lost[-1] + 1)),
        seconds=seconds,
    )


def measure_key_jerk(made: Motion, true: Motion, gap: tuple[int, int] | None = None) -> float:
    """Measure the largest jerk at the keys around a gap, over the 95th percentile of mocap's: of means over joints in
    the world, in third differences over four frames of which some are known and some in the gap. Without a gap it is
    all but the first and the last frame."""
    ours, theirs = (torch.diff(each.joint_positions(), n=3, dim=0).norm(dim=-1).mean(dim=-1) for each in (made, true))
    start, stop = gap or (1, made.num_frames - 1)
    beside = {*range(start - 3, start), *range(stop - 3, stop)} & set(range(len(ours)))
    return float(ours[sorted(beside)].max() / theirs.quantile(0.95).clamp_min(1e-9))


def query_gaps(clip: Motion, known: Bool[Tensor, " frames"]) -> GapQuery:
    """Ask for the frames of a canonical clip that are not known."""
    return CanonicalClip.of(clip, MissingMask.of_frames(~known, clip.num_joints)).query()


def _see(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    return see_from_hips(motion.joint_positions(), rotations.to_matrix(motion.local_quat_xyzw[:, 0]))
