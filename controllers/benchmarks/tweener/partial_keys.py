"""Benchmark of keys that are no whole poses: halves, places and drawings every 2 s of a clip, how they are met and what
is made between them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.benchmarks.shared.bones import scale_to_canonical_bones, slice_middle
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import GapSums, Method, compare_with_mocap, measure_gap
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.loose_keys import view_axes
from mapctl.intent.keyframes import Drawing, Key, Keys
from mapctl.kinematics import heading
from mapctl.metrics import worst_frame
from mapctl.motion import Motion

BETWEEN = 2 * PRIOR_FPS
"""Frames from key to key."""
MOST_GAPS = 3
"""Gaps of a clip that are measured, from its middle."""
VIEWS_DEG = (0, 45, 90)
"""Headings of the viewer of drawings, from that of the body at the first key."""
_WHOLE = Method("whole poses, interpolated", SlerpInbetweener(), InfillSettings(finish=False))


@dataclass(frozen=True)
class KeySums:
    """What is summed over the clips of a kind, and the largest of all of them."""

    made: GapSums
    """Between keys, beside mocap."""
    whole: GapSums
    """The same of an interpolation between whole poses at these keys."""
    missed: float
    """Largest distance of what a key tells in the world, cm."""
    off: tuple[float, ...]
    """Sums over drawings of mean distances of joints, from the hips, cm: in the plane, in space, and of a flat pose."""
    drawings: int
    """How many drawings."""
    step: float
    """Largest step of a joint, from the hips, in a frame, metres."""
    true_step: float
    """The same of mocap."""

    def __add__(self, other: "KeySums") -> "KeySums":
        return KeySums(
            self.made + other.made,
            self.whole + other.whole,
            max(self.missed, other.missed),
            tuple(one + another for one, another in zip(self.off, other.off, strict=True)),
            self.drawings + other.drawings,
            max(self.step, other.step),
            max(self.true_step, other.true_step),
        )

    def summarise(self) -> Row:
        """Return means, ratios of sums, and the largest values."""
        names, made = ("plane_cm", "space_cm", "flat_cm"), self.made.summarise()
        return {
            "missed_cm": self.missed,
            **{
                name: value / self.drawings if self.drawings else None
                for name, value in zip(names, self.off, strict=True)
            },
            "error_cm": made["error_cm"],
            "whole_cm": self.whole.summarise()["error_cm"],
            **{name: made[name] for name in ("planted_cm_s", "mocap_cm_s", "jerk")},
            "step": self.step / max(self.true_step, 1e-9),
        }


def benchmark_partial_keys(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Sequence[Method],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure methods by kind of clip (canonical, at PRIOR_FPS; 2 s at least) and of key, one each 2 s (`tell_keys`).

    How keys are missed: the largest distance in the world, cm; of drawings the mean one from the hips, in their plane
    and in space, beside that of the true pose laid flat into the plane of its hips. Between keys: errors of joints from
    the hips, cm, beside those of an interpolation of whole poses; planted toes' speed, cm/s, beside mocap's; jerk, and
    the largest step of a joint in a frame, over mocap's."""
    rows = []
    for number, (kind, clips) in enumerate(kinds.items()):
        fit = [_cut_keyed(scale_to_canonical_bones(clip)) for clip in clips]
        parts = [part for part in fit if part is not None]
        told = [tell_keys(part) for part in parts]
        wholes = [measure_gap(part, _WHOLE, _find_keys(part)) for part in parts]
        for what in told[0] if told else ():
            for method in methods:
                each = zip(parts, told, wholes, strict=True)
                found = [_measure(part, keys[what], whole, method) for part, keys, whole in each]
                summed = sum(found[1:], found[0])
                rows.append({"kind": kind, "keys": what, "clips": len(parts), "by": method.name, **summed.summarise()})
        if progress is not None:
            progress(number + 1, len(kinds))
    return rows


def tell_keys(clip: Motion) -> dict[str, Keys]:
    """Tell a canonical clip by a key each 2 s, by kind of key: the upper and the lower half in turn, places alone, and
    drawings of all joints with their places, from where one viewer stands all the time."""
    frames, places = _find_keys(clip).nonzero()[:, 0].tolist(), clip.joint_positions()
    facing = math.degrees(float(heading(clip.local_quat_xyzw[0, 0])))
    halves = (Key(frame, half="lower" if number % 2 else "upper") for number, frame in enumerate(frames))
    found = {"halves": Keys(tuple(halves)), "places": Keys(tuple(Key(frame, root_only="place") for frame in frames))}
    for view in VIEWS_DEG:
        drawn = {frame: _draw(places[frame], clip.skeleton.names, facing + view) for frame in frames}
        found[f"drawings at {view}"] = Keys(tuple(Key(frame, drawing=drawn[frame], placed=True) for frame in frames))
    return found


def measure_drawn_pose(
    made: Float[Tensor, "joints 3"], true: Float[Tensor, "joints 3"], view_deg: float
) -> tuple[float, float, float]:
    """Measure mean distances of joints from the hips, cm: in the plane of a drawing of the true pose, in space, and in
    space of the true pose laid flat into the plane of its hips. Places are in the world, metres."""
    axes = view_axes(true.new_tensor(math.radians(view_deg))).mT
    away, body = (made - made[0]) - (true - true[0]), true - true[0]
    depth = body - body @ axes @ axes.mT
    plane, space, flat = (100 * float(each.norm(dim=-1).mean()) for each in (away @ axes, away, depth))
    return plane, space, flat


def _draw(places: Float[Tensor, "joints 3"], names: Sequence[str], view_deg: float) -> Drawing:
    seen = places @ view_axes(places.new_tensor(math.radians(view_deg))).mT
    return Drawing({name: (x, y) for name, (x, y) in zip(names, seen.tolist(), strict=True)}, view_deg)


def _measure(clip: Motion, keys: Keys, whole: GapSums, method: Method) -> KeySums:
    done = tween(clip, keys, method.inbetweener, settings=method.settings)
    missed = [row.get("missed_cm", 0.0) for row in measure_keyframe_errors(done.motion, clip, keys)]
    made, true = done.motion.joint_positions(), clip.joint_positions()
    drawn = [(key.frame, key.drawing.view_deg) for key in keys.checked(clip) if key.drawing is not None]
    off = [measure_drawn_pose(made[frame], true[frame], view) for frame, view in drawn]
    plane, space, flat = (sum(column) for column in zip(*off, strict=True)) if off else (0.0, 0.0, 0.0)
    step, true_step = (worst_frame.measure_peaks(each, each[:, 0], PRIOR_FPS).step for each in (made, true))
    between = compare_with_mocap(done.motion, clip, ~_find_keys(clip), seconds=done.seconds)
    return KeySums(between, whole, max(missed), (plane, space, flat), len(off), step, true_step)


def _cut_keyed(clip: Motion) -> Motion | None:
    """Cut the middle from key to key; None for a clip that is shorter than one gap."""
    gaps = min(MOST_GAPS, (clip.num_frames - 1) // BETWEEN)
    return slice_middle(clip, gaps * BETWEEN + 1) if gaps else None


def _find_keys(clip: Motion) -> Bool[Tensor, " frames"]:
    return torch.arange(clip.num_frames) % BETWEEN == 0
