"""Benchmark of transitions in which more is told than the two poses: hands, a foot or the hips in the middle frame."""

from collections.abc import Callable, Mapping, Sequence

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.transitions.appearance import measure_appearance
from controllers.benchmarks.transitions.table import ALL_KINDS, average_measures
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.tween import measure_keyframe_errors, tween
from mapctl.intent.keyframes import Key, Keys
from mapctl.metrics import transitions
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL

FRAMES = 30
"""Frames from the one pose to the other."""
_MIDDLE = FRAMES // 2
_HANDS = ("leftHand", "rightHand")
_OVERHEAD = "hands overhead"
_ABOVE_HEAD, _NEARER = 0.15, 0.8  # metres over the head; share of the hands' distance from it over the ground


def tell_middles(part: Motion) -> dict[str, Keys]:
    """Tell what is to hold in the middle frame of a canonical motion of FRAMES + 1 frames, between its first pose and
    its last: what holds there in mocap, and both hands over the head, where they hardly ever are."""
    places, head = part.joint_positions()[_MIDDLE], CANONICAL.index("head")
    across = torch.tensor([_NEARER, 0.0, _NEARER]).to(places)
    above = torch.tensor([0.0, _ABOVE_HEAD, 0.0]).to(places)
    high = {
        name: tuple((places[head] + (places[CANONICAL.index(name)] - places[head]) * across + above).tolist())
        for name in _HANDS
    }
    middles = {
        "nothing": None,
        "both hands": Key(_MIDDLE, limbs=_HANDS),
        "a foot": Key(_MIDDLE, limbs=("leftFoot",)),
        "the hips": Key(_MIDDLE, root_only=True),
        _OVERHEAD: Key(_MIDDLE, places=high),
    }
    return {what: Keys((0, *([] if key is None else [key]), FRAMES)) for what, key in middles.items()}


def benchmark_partial_keys(
    kinds: Mapping[str, Sequence[Motion]],
    inbetweeners: Mapping[str, Inbetweener],
    *,
    finish: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure one window of FRAMES frames from the middle of each clip (canonical, at PRIOR_FPS; shorter ones are left
    out), told more and more: ADE, cm, where mocap did so too, how far what was told is missed, cm, and what a viewer
    sees (`measure_appearance`). Rows are means of the kinds' own figures, and the worst frame of all.
    """
    parts = {kind: [_cut_middle(clip) for clip in clips if clip.num_frames > FRAMES] for kind, clips in kinds.items()}
    found: dict[tuple[str, str], list[Row]] = {}
    for number, windows in enumerate(parts.values()):
        told = [tell_middles(window) for window in windows]
        for what in told[0] if told else ():
            for name, inbetweener in inbetweeners.items():
                row = _measure(
                    windows, [keys[what] for keys in told], inbetweener, finish=finish, true=what != _OVERHEAD
                )
                found.setdefault((what, name), []).append(row)
        if progress is not None:
            progress(number + 1, len(parts))
    count = sum(len(windows) for windows in parts.values())
    return [
        {"told": what, "by": name, "windows": count, "kind": ALL_KINDS} | average_measures(rows)
        for (what, name), rows in found.items()
    ]


def _cut_middle(clip: Motion) -> Motion:
    first = (clip.num_frames - FRAMES - 1) // 2
    return clip.slice(first, first + FRAMES + 1)


def _measure(
    windows: Sequence[Motion], told: Sequence[Keys], inbetweener: Inbetweener, *, finish: bool, true: bool
) -> Row:
    errors, missed, made = [], [], []
    for window, keys in zip(windows, told, strict=True):
        done = tween(window, keys, inbetweener, settings=InfillSettings(finish=finish)).motion
        inner = (slice(1, FRAMES), slice(None))
        errors.append(
            transitions.compute_joint_distances(
                done.joint_positions()[None, *inner], window.joint_positions()[None, *inner]
            )[0]
        )
        missed += [row.get("missed_cm", 0.0) for row in measure_keyframe_errors(done, window, keys)]
        made.append(done)
    ade = {"ade_cm": 100 * sum(errors) / len(errors)} if true else {}
    return ade | {"missed_cm": max(missed)} | measure_appearance(made)
