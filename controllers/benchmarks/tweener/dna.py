"""Benchmark of motion DNA (Zhou et al. 2020, sections 3.5.1 and 4.8): the same keys under DNA of clips of different
content, in pairs.

How near poses come by themselves says little: another clip of the same content comes near as well. So each DNA's poses
are looked for in the motion made under it, and in those made under the others.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.held_out import HeldOut, find_held_out
from controllers.benchmarks.shared.tables import Row
from controllers.denoising.denoise import begins_with_tpose
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.tween import tween
from mapctl import formats, kinematics, motion_dna, retarget, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.keyframes import Keys
from mapctl.metrics.feet import ToeMeasurements, contact_speed
from mapctl.motion import Motion
from mapctl.motion_dna import MotionDna
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_NAMED = re.compile(r"dataset-\d+_([^_/]+)_([^_/]+)_")
_SHORTEST = 45  # frames of a clip that tells a style
_INTERVAL_SECONDS = 3.0  # of Eq. 12, for each of which an interval is to have one pose
_DWELL_METRES, _LEAST_DWELL = 0.06, 5  # metres, and frames: what is kept for less flashes up
_NO_PAIRS = {"pairs_percent": float("nan"), "nearer_cm": float("nan")}
_FASTEST = 0.995
_WINDOW_SECONDS = 5
BEYOND_SECONDS, _BEYOND_EXAMPLES = 40.0, 4
"""Seconds between keys that no network sees both at once, and how many examples are tried there."""
_STANDS = 0.3  # metres that hips sway at most


@dataclass(frozen=True, eq=False)
class StyleClip:
    """A clip that no training saw, on canonical bones at PRIOR_FPS."""

    content: str
    """What is done in it."""
    manner: str
    """In which manner; empty where that is not told."""
    motion: Motion
    """It."""
    dna: MotionDna = field(init=False)
    """Its poses."""

    def __post_init__(self):
        object.__setattr__(self, "dna", motion_dna.of(self.motion))


StyledMaker = Callable[[MotionDna | None], Inbetweener]
"""Returns the in-betweener that is told poses, or none."""


def load_style_clips(data: Path, held_out: HeldOut) -> list[StyleClip]:
    """Load all held-out clips of 1.5 s and more. Their names tell their content; of others the folder stands for it."""
    clips = []
    for path in find_held_out(data, held_out):
        motion = formats.load(path)
        first = 1 if begins_with_tpose(motion) else 0
        canonical = retarget.to_canonical(motion.slice(first, motion.num_frames))[0].resample(PRIOR_FPS)
        if canonical.num_frames >= _SHORTEST:
            named = _NAMED.search(path.name)
            content, manner = named.groups() if named else (path.parent.name, "")
            clips.append(StyleClip(content, manner, scale_to_canonical_bones(canonical)))
    return clips


def choose_examples(clips: Sequence[StyleClip], count: int) -> list[StyleClip]:
    """Choose so many clips, each of another content, evenly among all contents; of each the longest. Folders, which
    hold all kinds of content, count as one only where names tell too few. RequestError for fewer than two contents."""
    named = [clip for clip in clips if clip.manner]
    longest: dict[str, StyleClip] = {}
    for clip in named if len({clip.content for clip in named}) >= count else clips:
        if clip.content not in longest or clip.motion.num_frames > longest[clip.content].motion.num_frames:
            longest[clip.content] = clip
    if min(count, len(longest)) < 2:
        raise RequestError(f"pairs need clips of two contents at least, got {count} of {len(longest)}")
    names, count = sorted(longest), min(count, len(longest))
    return [longest[names[number * len(names) // count]] for number in range(count)]


def choose_keys(clips: Sequence[StyleClip]) -> list[Motion]:
    """Choose the clips whose first and last poses are keys: the longest walk that goes straight, and the longest clip
    that stays in its place; RequestError where there is neither."""
    walks = [clip.motion for clip in clips if clip.content == "walk"]
    stands = [clip.motion for clip in clips if _measure_way(clip.motion) < _STANDS]
    found = [max(each, key=lambda motion: motion.num_frames) for each in (walks, stands) if each]
    if not found:
        raise RequestError("no clip that was kept from training walks or stands")
    return found


def _measure_way(motion: Motion) -> float:
    """Measure how far the hips get from where they begin, metres."""
    return float((motion.root_position - motion.root_position[0])[:, ::2].norm(dim=-1).max())


def lay_keys(clip: Motion, seconds: float) -> Motion:
    """Return the first and the last pose of a clip so many seconds apart, where they were, and no other."""
    frames = round(seconds * PRIOR_FPS) + 1
    at = torch.zeros(frames, dtype=torch.long)
    at[-1] = clip.num_frames - 1
    return replace(clip, root_position=clip.root_position[at], local_quat_xyzw=clip.local_quat_xyzw[at], source=None)


@dataclass(frozen=True, eq=False)
class _Made:
    """A motion through the keys, as it is measured."""

    bare: Float[Tensor, "frames joints 3"]  # places from the hips without their rotation, metres
    toes: ToeMeasurements

    @staticmethod
    def of(motion: Motion) -> "_Made":
        toes = ToeMeasurements.of(motion.joint_positions()[:, list(TOE_JOINTS)], float(motion.fps))
        return _Made(take_bare_poses(motion), toes)

    @property
    def fastest(self) -> float:
        """Speed of the fastest joint in all but the fastest frames, m/s."""
        speed = torch.diff(self.bare, dim=0).norm(dim=-1).amax(dim=-1) * PRIOR_FPS
        return float(speed.quantile(_FASTEST))

    @property
    def speed(self) -> float:
        """Mean speed of joints in the five seconds in which they are slowest, cm/s: who freezes anywhere has none."""
        speed = torch.diff(self.bare, dim=0).norm(dim=-1).mean(dim=-1)
        return 100 * PRIOR_FPS * float(min(part.mean() for part in self._cut(speed)))

    @property
    def spread(self) -> float:
        """Mean distance of joints from where they are on average, in the five seconds in which that is least, cm."""
        return 100 * float(min((part - part.mean(dim=0)).norm(dim=-1).mean() for part in self._cut(self.bare)))

    def _cut(self, frames: Tensor) -> Iterator[Tensor]:
        """Cut into windows of five seconds; what is shorter is one."""
        count = max(1, len(frames) // (_WINDOW_SECONDS * PRIOR_FPS))
        return iter(frames.tensor_split(count))

    @property
    def jerk(self) -> float:
        """Mean third difference, m/s^3."""
        return float(torch.diff(self.bare, n=3, dim=0).norm(dim=-1).mean()) * PRIOR_FPS**3

    @property
    def sliding(self) -> float:
        """Speed of planted toes, cm/s; NaN where none is."""
        return 100 * contact_speed(self.toes)


def take_bare_poses(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Take all poses as motion DNA has them, without the hips: metres from them, without their rotation."""
    local = rotations.to_matrix(motion.local_quat_xyzw)
    local[:, 0] = torch.eye(3, dtype=local.dtype)
    return kinematics.positions_from_matrices(CANONICAL, local)[:, 1:].float()


def measure_distances(bare: Float[Tensor, "frames joints 3"], dna: MotionDna) -> Float[Tensor, "poses frames"]:
    """Measure how far each pose of DNA is from each frame: mean over joints, cm."""
    return 100 * (dna.poses[:, None, 1:] - bare).norm(dim=-1).mean(dim=-1)


def measure_dwell(bare: Float[Tensor, "frames joints 3"], dna: MotionDna) -> list[int]:
    """Count for each pose of DNA the frames around that which comes nearest to it in which the body stays within 6 cm
    of what it is there: a pose that flashes up stays for one."""
    counts = []
    for nearest in measure_distances(bare, dna).argmin(dim=1).tolist():
        near = (bare - bare[nearest]).norm(dim=-1).mean(dim=-1) < _DWELL_METRES
        after = (
            int((~near[nearest:]).to(torch.uint8).argmax()) if bool((~near[nearest:]).any()) else len(near) - nearest
        )
        back = near[: nearest + 1].flip(0)
        before = int((~back).to(torch.uint8).argmax()) if bool((~back).any()) else nearest + 1
        counts.append(after + before - 1)
    return counts


def benchmark_dna(
    keys: Sequence[Motion],
    examples: Sequence[StyleClip],
    clips: Sequence[StyleClip],
    make: StyledMaker,
    pasting: Inbetweener,
    *,
    seconds: float = 8.0,
    settings: InfillSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure motions through the keys of each clip, so many seconds apart, under the DNA of each example: the share of
    pairs, %, in which its poses come nearer in the motion made under it than in that under another, and by how much,
    cm; Eq. 11 and Eq. 12 in cm; the fastest joint over the examples' own; planted toes, cm/s, and jerk, m/s^3; joints'
    speed, cm/s, and the spread of poses, cm, in the five seconds in which they are least; how long poses stay, frames,
    and how many flash up, %. Beside it no DNA, its poses pasted as keys for `pasting`, keys 40 s apart, and mocap among
    `clips`.
    """
    made: dict[str, list[list[_Made]]] = {}

    def fill(kind: str, told: Iterator[tuple[Motion, Keys, Inbetweener]]) -> None:
        motions = [_Made.of(tween(*each, settings=settings).motion) for each in told]
        made.setdefault(kind, []).append(motions)

    few = examples[:_BEYOND_EXAMPLES]
    beyond = f" {BEYOND_SECONDS:g} s apart"
    for number, key in enumerate(keys):
        near, far = (lay_keys(key, each) for each in (seconds, BEYOND_SECONDS))
        fill("DNA", ((near, _ends(near), make(example.dna)) for example in examples))
        fill("no DNA", iter([(near, _ends(near), make(None))]))
        fill("poses pasted as keys", ((*paste_poses(near, example.motion), pasting) for example in examples))
        fill("DNA" + beyond, ((far, _ends(far), make(example.dna)) for example in few))
        fill("no DNA" + beyond, iter([(far, _ends(far), make(None))]))
        if progress is not None:
            progress(number + 1, len(keys))
    usual = sum(_Made.of(example.motion).fastest for example in examples) / len(examples)
    rows = []
    for kind, found in made.items():
        asked = few if kind.endswith(beyond) else examples
        found = [row * len(asked) if kind.startswith("no DNA") else row for row in found]
        told = [(one, example.dna) for row in found for one, example in zip(row, asked, strict=True)]
        pairs = _NO_PAIRS if kind.startswith("no DNA") else _compare_pairs(found, asked)
        apart = BEYOND_SECONDS if kind.endswith(beyond) else seconds
        rows.append({"by": kind, **pairs, **_measure(told, usual, apart)})
    return [*rows, *_measure_mocap(examples, clips, usual, seconds)]


def _ends(motion: Motion) -> Keys:
    return Keys((0, motion.num_frames - 1))


def paste_poses(plain: Motion, clip: Motion) -> tuple[Motion, Keys]:
    """Paste representative poses of a clip between the first and the last frame of a motion, evenly, as keys: turned to
    the way there, with their own height."""
    chosen = motion_dna.choose_frames(clip.local_quat_xyzw, motion_dna.POSES)
    frames, last = len(chosen), plain.num_frames - 1
    at = [round((number + 1) * last / (frames + 1)) for number in range(frames)]
    quats, root = plain.local_quat_xyzw.clone(), plain.root_position.clone()
    share = torch.tensor(at, dtype=root.dtype)[:, None] / last
    facing = kinematics.heading(quats[[0, last], 0])
    towards = facing[0] + rotations.wrap_angle(facing[1] - facing[0]) * share[:, 0]
    turn = rotations.about_y(towards - kinematics.heading(clip.local_quat_xyzw[chosen, 0]))
    quats[at] = clip.local_quat_xyzw[chosen]
    quats[at, 0] = rotations.multiply(turn, clip.local_quat_xyzw[chosen, 0])
    root[at] = torch.lerp(root[:1], root[last:], share)
    root[at, 1] = clip.root_position[chosen, 1]
    return replace(plain, local_quat_xyzw=quats, root_position=root), Keys((0, *at, last))


def _compare_pairs(found: Sequence[Sequence[_Made]], examples: Sequence[StyleClip]) -> Row:
    """Compare how near each DNA's poses come under it and under the others, through the same keys."""
    gains = []
    for row in found:
        errors = torch.tensor([[compute_eq_11(one.bare, example.dna) for example in examples] for one in row])
        gains.append((errors - errors.diagonal())[~torch.eye(len(examples), dtype=torch.bool)])
    gain = torch.cat(gains)
    return {"pairs_percent": 100 * float((gain > 0).float().mean()), "nearer_cm": float(gain.mean())}


def _measure(told: Sequence[tuple[_Made, MotionDna]], usual: float, seconds: float) -> Row:
    """Measure motions, each with the DNA that it is to heed."""
    dwell = [count for one, dna in told for count in measure_dwell(one.bare, dna)]
    columns = {
        "eq_11_cm": [compute_eq_11(one.bare, dna) for one, dna in told],
        "eq_12_cm": [compute_eq_12(one.bare, dna, seconds) for one, dna in told],
        "fastest": [one.fastest / usual for one, _ in told],
        "planted_cm_s": [one.sliding for one, _ in told],
        "jerk_m_s3": [one.jerk for one, _ in told],
        "speed_cm_s": [one.speed for one, _ in told],
        "spread_cm": [one.spread for one, _ in told],
    }
    means = {name: float(np.nanmean(values)) for name, values in columns.items()}
    flashed = 100 * sum(count < _LEAST_DWELL for count in dwell) / len(dwell)
    return means | {"dwell": float(torch.tensor(dwell).float().median()), "flashed_percent": flashed}


def compute_eq_11(bare: Float[Tensor, "frames joints 3"], dna: MotionDna) -> float:
    """Mean over poses of DNA of the distance from the nearest frame, cm (Eq. 11 without its square)."""
    return float(measure_distances(bare, dna).amin(dim=1).mean())


def compute_eq_12(bare: Float[Tensor, "frames joints 3"], dna: MotionDna, seconds: float) -> float:
    """Mean distance from the nearest pose of as many frames, those nearest to one, as an interval between keys has
    times 3 s, cm (Eq. 12 without its square)."""
    nearest = measure_distances(bare, dna).amin(dim=0)
    count = max(1, int(seconds / _INTERVAL_SECONDS))
    return float(nearest.sort().values[:count].mean())


def _measure_mocap(
    examples: Sequence[StyleClip], clips: Sequence[StyleClip], usual: float, seconds: float
) -> Iterator[Row]:
    """Measure how near other clips come to the examples' poses: of the same class, the same content, and another."""
    relations: dict[str, Callable[[StyleClip, StyleClip], bool]] = {
        "mocap of the same class": lambda one, other: (one.content, one.manner) == (other.content, other.manner),
        "mocap of the same content": lambda one, other: one.content == other.content and one.manner != other.manner,
        "mocap of another content": lambda one, other: one.content != other.content,
    }
    for by, related in relations.items():
        told = [
            (_Made.of(other.motion), example.dna)
            for example in examples
            for other in [clip for clip in clips if clip is not example and related(example, clip)][:3]
        ]
        if told:
            yield {"by": by, **_NO_PAIRS, **_measure(told, usual, seconds)}
