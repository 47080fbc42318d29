"""A picture of a rig as it was understood: its T-pose with both names of each joint, frames of the clip, and doubts.

Imported late, where it is needed: matplotlib may not be installed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from textwrap import wrap
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib import font_manager
from matplotlib.figure import Figure

from mapctl import kinematics, retarget, rotations
from mapctl.formats.atomic import atomic_path
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.doubts import Fit
from mapctl.skeleton import CANONICAL

_SIZE, _DPI = (16.0, 9.6), 100  # inches
_LEFT, _RIGHT, _MIDDLE, _UNMATCHED, _DOUBT = "#4c78a8", "#f58518", "#333333", "#b5b5b5", "#d62728"
_MAX_LINES = 5  # of reasons under the picture
_MARGIN, _HEADROOM = 0.12, 0.2  # metres about a body, and over it in the T-pose
_MAX_LINE = 112  # characters of a line of reasons

# Labels stand in two columns beside the body, each with a line to its point, none over another.
_MAX_NAME = 24  # characters of a name
_GAP = 0.056  # of the height of the axes between two labels
_TOP, _BOTTOM = 0.965, 0.035  # of the height of the axes
_HAN_FONTS = ("Noto Sans CJK JP", "Noto Sans CJK SC", "IPAexGothic", "IPAGothic", "WenQuanYi Zen Hei", "Yu Gothic")

Places = Float[np.ndarray, "joints 3"]
"""Positions of the rig's own joints, metres: Y up, facing +Z."""


@dataclass(frozen=True, eq=False)
class RigPicture:
    """What is drawn of a rig."""

    rigmap: RigMap
    """The rig as it was understood."""
    motion: Motion
    """A clip of it."""
    fit: Fit
    """What is doubtful about it."""
    title: str
    """Name of the clip."""

    @cached_property
    def colours(self) -> Mapping[int, str]:
        """Colour of each joint of the rig that is a canonical one, or that lies between two of them."""
        found, parents = {}, self.rigmap.rig_skeleton.parents
        matched = set(self.rigmap.joints.values())
        for name, joint in self.rigmap.joints.items():
            chain = [joint]
            while parents[chain[-1]] >= 0 and parents[chain[-1]] not in matched and name != "hips":
                chain.append(parents[chain[-1]])
            colour = _LEFT if name.startswith("left") else _RIGHT if name.startswith("right") else _MIDDLE
            found |= dict.fromkeys(chain if parents[chain[-1]] in matched else chain[:1], colour)
        return found

    @cached_property
    def shown(self) -> list[int]:
        """Joints that are drawn: what hangs from a canonical joint, and not what carries the body."""
        matched, found = set(self.rigmap.joints.values()), []
        for joint, parent in enumerate(self.rigmap.rig_skeleton.parents):
            if joint in matched or parent in found:
                found.append(joint)
        return found

    def numbers_of(self, name: str) -> list[int]:
        """Return the numbers of the doubts about a canonical joint, from 1."""
        return [number for number, doubt in enumerate(self.fit.doubts, 1) if name in doubt.joints]

    def tpose(self) -> Places:
        """Return the rig's joints in the T-pose that was found, hips over the origin."""
        frames = 1
        still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(frames, CANONICAL.num_joints, 4)
        root = torch.zeros(frames, 3, dtype=torch.float64)
        standing = Motion(self.rigmap.skeleton, self.motion.fps, root, still.clone())
        return self._turn_upright(retarget.from_canonical(standing, self.rigmap), 0, heading=0.0)

    def frame(self, number: int) -> Places:
        """Return the rig's joints in a frame of the clip, turned to face +Z, hips over the origin."""
        picked = self.motion.slice(number, number + 1)
        canonical = retarget.to_canonical(picked, retarget.as_rig(self.rigmap))[0]
        heading = float(kinematics.heading(canonical.local_quat_xyzw[0, 0]))
        return self._turn_upright(picked, 0, heading=heading)

    def _turn_upright(self, motion: Motion, number: int, *, heading: float) -> Places:
        places = motion.joint_positions()[number]
        upright = self.rigmap.upright_quat_xyzw
        if upright is not None:
            places = rotations.rotate(upright.expand(len(places), 4), places)
        places = places - places[self.rigmap.joints["hips"]] * places.new_tensor([1.0, 0.0, 1.0])
        return rotations.rotate_about_y(places, torch.full((len(places),), -heading, dtype=places.dtype)).numpy()


@dataclass(frozen=True)
class Label:
    """A label with two lines."""

    title: str
    """Its first line."""
    name: str
    """Its second line, smaller."""
    colour: str
    """Colour of its first line."""
    leader: str
    """Colour of the line to its point."""
    point: tuple[float, float]
    """What it is the label of, in data coordinates."""
    on_right: bool
    """Whether it stands in the right column."""


def plot_rig(picture: RigPicture, path: str | PathLike[str]) -> None:
    """Write a PNG, 1600 pixels wide."""
    names = "".join(picture.rigmap.rig_skeleton.names)
    with matplotlib.rc_context({"font.family": font_families(names)}):
        figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white")
        _draw(figure, picture)
        with atomic_path(path) as scratch:
            figure.savefig(scratch, format="png", dpi=_DPI)


def _draw(figure: Any, picture: RigPicture) -> None:
    tpose = _stand_on_floor(picture, picture.tpose())
    height = float(tpose[picture.shown, 1].max()) + _HEADROOM
    tall = 0.765 * _SIZE[1]
    front = figure.add_axes((0.005, 0.155, 0.565, 0.765))
    side = figure.add_axes((0.585, 0.155, 0.135, 0.765))
    _draw_body(front, picture, tpose, 0)
    _draw_body(side, picture, tpose, 2)
    _set_scale(front, height, marks=False, width=0.565 * _SIZE[0], tall=tall, title="T-pose, from the front")
    _set_scale(side, height, width=0.135 * _SIZE[0], tall=tall, title="from its right")
    draw_columns(front, _label_joints(picture, tpose))
    _draw_frames(figure, picture)
    _draw_axes(figure, picture)
    _write(figure, picture)


def _draw_frames(figure: Any, picture: RigPicture) -> None:
    """Draw the first and the middle frame, from the front and from the right."""
    for row, (name, number) in enumerate((("first frame", 0), ("middle frame", picture.motion.num_frames // 2))):
        places = _stand_on_floor(picture, picture.frame(number))
        reach = float(places[picture.shown, 1].max())
        for column, (axis, seen) in enumerate(((0, "front"), (2, "right"))):
            rectangle = (0.735 + 0.132 * column, 0.555 - 0.4 * row, 0.127, 0.365)
            axes = figure.add_axes(rectangle)
            _draw_body(axes, picture, places, axis, small=True)
            wide, tall = rectangle[2] * _SIZE[0], rectangle[3] * _SIZE[1]
            spread = places[picture.shown, axis]
            _set_scale(axes, reach, width=wide, tall=tall, title=f"{name}, {seen}", spread=spread)


def _stand_on_floor(picture: RigPicture, places: Places) -> Places:
    return places - np.array([0.0, places[picture.shown, 1].min(), 0.0])


def _draw_body(axes: Any, picture: RigPicture, places: Places, across: int, *, small: bool = False) -> None:
    """Draw bones and joints; `across` is the axis that goes to the right."""
    flat, colours, share = places[:, [across, 1]], picture.colours, 0.55 if small else 1.0
    joints, hips = picture.rigmap.joints, picture.rigmap.joints["hips"]
    for joint in picture.shown:
        parent = picture.rigmap.rig_skeleton.parents[joint]
        if parent in picture.shown:
            matched = joint in colours and joint != hips
            width, colour = (4.0, colours[joint]) if matched else (1.3, _UNMATCHED)
            line = flat[[parent, joint]].T
            axes.plot(*line, color=colour, linewidth=width * share, solid_capstyle="round", zorder=2 if matched else 1)
    others = [joint for joint in picture.shown if joint not in joints.values()]
    axes.scatter(*flat[others].T, s=9 * share, color=_UNMATCHED, zorder=3)
    for name, joint in joints.items():
        edge, width = (_DOUBT, 2.2) if picture.numbers_of(name) else ("white", 1.0)
        own = {"s": 70 * share**2, "edgecolors": edge, "linewidths": width * share, "zorder": 4}
        axes.scatter(*flat[joint], color=colours[joint], **own)


def _label_joints(picture: RigPicture, places: Places) -> list[Label]:
    """Make a label for each canonical joint: those of the left arm and leg stand right, as the body is seen."""
    labels, skeleton = [], picture.rigmap.rig_skeleton
    for name, joint in picture.rigmap.joints.items():
        numbers, colour = picture.numbers_of(name), picture.colours[joint]
        title = f"{name} [{', '.join(map(str, numbers))}]" if numbers else name
        point, on_right = (float(places[joint, 0]), float(places[joint, 1])), name.startswith("left")
        on_right = on_right or name in ("hips", "spine", "chest")
        labels.append(Label(title, skeleton.names[joint], _DOUBT if numbers else colour, colour, point, on_right))
    return labels


def _set_scale(
    axes: Any,
    height: float,
    *,
    width: float,
    tall: float,
    title: str,
    marks: bool = True,
    spread: np.ndarray | None = None,
) -> None:
    """Set limits so that a metre is as long both ways, with the floor and a scale in metres."""
    reach = height + 2 * _MARGIN
    middle = 0.0 if spread is None else float(spread.max() + spread.min()) / 2
    if spread is not None:
        reach = max(reach, (float(np.ptp(spread)) + 2 * _MARGIN) * tall / width)
    half = reach * width / tall / 2
    axes.set(xlim=(middle - half, middle + half), ylim=(-_MARGIN, reach - _MARGIN), xticks=[])
    step = 0.5 if reach < 4 else 10 ** np.floor(np.log10(reach / 2))
    heights = np.arange(0, reach - _MARGIN, step)
    axes.set_yticks(heights)
    axes.tick_params(axis="y", direction="in", length=0, pad=-3, labelsize=7, labelcolor="#888888")
    axes.set_yticklabels([f"{height:g} m" if marks else "" for height in heights], ha="left", va="bottom")
    ends = (0.0, 1.0) if marks else (0.17, 0.83)  # beside labels
    for height in heights:
        axes.axhline(height, *ends, color="#ececec" if height else "#888888", linewidth=1.0, zorder=0)
    for edge in axes.spines.values():
        edge.set_visible(False)
    axes.set_title(title, fontsize=9.5, color="#555555", pad=4)


def _draw_axes(figure: Any, picture: RigPicture) -> None:
    """Draw which axes of the file point up and where the body faces, beside the view from its right."""
    axes = figure.add_axes((0.585, 0.155, 0.135, 0.765), zorder=5)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.set_axis_off()
    arrow = dict(arrowstyle="-|>", color="#2ca02c", linewidth=1.6, shrinkA=0, shrinkB=0)
    axes.annotate("", (0.1, 0.985), (0.1, 0.935), arrowprops=arrow)
    axes.annotate("", (0.36, 0.935), (0.1, 0.935), arrowprops=arrow)
    axes.text(0.15, 0.975, f"up: {_sign(picture.rigmap.up)}", fontsize=8.5, color="#2ca02c", va="center")
    axes.text(0.4, 0.935, f"facing: {_sign(picture.rigmap.facing)}", fontsize=8.5, color="#2ca02c", va="center")


def _sign(axis: str) -> str:
    return f"+{axis}" if len(axis) == 1 else axis


def _write(figure: Any, picture: RigPicture) -> None:
    """Write the title above, and verdict and reasons below."""
    rig, found, doubts = picture.rigmap.rig, picture.rigmap.match, picture.fit.doubts
    score = "" if found is None else f", score {found.score:.2f}"
    figure.text(0.012, 0.968, picture.title, fontsize=14, weight="bold", va="center")
    told = f"rig {rig.name}{score}, rest pose {picture.rigmap.rest}, T-pose from {picture.rigmap.tpose_from}"
    figure.text(0.988, 0.968, told, fontsize=11, va="center", ha="right", color="#555555")
    colour = _DOUBT if doubts else "#2ca02c"
    figure.text(0.012, 0.128, f"fit: {picture.fit.verdict}", fontsize=12, weight="bold", color=colour, va="center")
    reasons = [f"[{number}] {doubt.reason}" for number, doubt in enumerate(doubts, 1)] or [_describe_sure(picture)]
    lines = [line for reason in reasons for line in wrap(printable(reason), _MAX_LINE, subsequent_indent="     ")]
    lines = lines if len(lines) <= _MAX_LINES else [*lines[: _MAX_LINES - 1], "and more: see mapctl info"]
    for number, line in enumerate(lines):
        ink = _DOUBT if doubts else "#555555"
        figure.text(0.115, 0.128 - 0.025 * number, line, fontsize=10, color=ink, va="center")
    _write_key(figure, picture)


def _describe_sure(picture: RigPicture) -> str:
    absent = [name for name in CANONICAL.names if name not in picture.rigmap.joints]
    return f"the rig has no {', '.join(absent)}" if absent else "every joint is known"


def _write_key(figure: Any, picture: RigPicture) -> None:
    others = picture.rigmap.rig_skeleton.num_joints - len(picture.rigmap.joints)
    words = (("left", _LEFT), ("right", _RIGHT), ("middle", _MIDDLE), ("doubtful", _DOUBT))
    for (word, colour), x in zip(words, (0.79, 0.825, 0.87, 0.925), strict=True):
        figure.text(x, 0.128, word, fontsize=10, color=colour, weight="bold", va="center")
    figure.text(0.79, 0.103, f"no canonical joint ({others})", fontsize=10, color="#999999", va="center")


def draw_columns(axes: Any, labels: Sequence[Label]) -> None:
    """Draw labels at both edges of the axes, in the order of the heights of their points."""
    for on_right in (False, True):
        own = sorted((label for label in labels if label.on_right == on_right), key=_rank)
        for label, height in zip(own, spread([_to_height(axes, label) for label in own]), strict=True):
            _draw_label(axes, label, height)


def _rank(label: Label) -> tuple[float, float]:
    """Return what orders labels from the top: of points at one height the innermost first, so that no lines cross."""
    return -round(label.point[1], 2), abs(label.point[0])


def spread(heights: Sequence[float]) -> list[float]:
    """Move heights, highest first, apart to at least the gap between two labels, within the axes, and as little as
    that takes."""
    gap = min(_GAP, (_TOP - _BOTTOM) / max(len(heights) - 1, 1))
    placed, top = [], _TOP
    for number, height in enumerate(heights):
        least = _BOTTOM + gap * (len(heights) - 1 - number)
        placed.append(max(min(height, top), least))
        top = placed[-1] - gap
    return placed


def font_families(text: str) -> list[str]:
    """Return the fonts for a text: with one that has its Chinese and Japanese characters, where one is installed."""
    known = {font.name for font in font_manager.fontManager.ttflist}
    return ["DejaVu Sans", *(font for font in _HAN_FONTS if font in known and not text.isascii())]


def printable(name: str) -> str:
    """Return a name as the fonts at hand can show it: other characters as their code."""
    fonts = [font_manager.get_font(font_manager.findfont(family)) for family in font_families(name)]
    shown = "".join(c if any(font.get_char_index(ord(c)) for font in fonts) else f"\\u{ord(c):04x}" for c in name)
    return shown


def shorten(name: str) -> str:
    """Shorten a long name in its middle."""
    return name if len(name) <= _MAX_NAME else name[: _MAX_NAME // 2] + "..." + name[3 - _MAX_NAME // 2 :]


def _to_height(axes: Any, label: Label) -> float:
    low, high = axes.get_ylim()
    return (label.point[1] - low) / (high - low)


def _draw_label(axes: Any, label: Label, height: float) -> None:
    low, high = axes.get_xlim()
    bottom, top = axes.get_ylim()
    edge, align = (0.995, "right") if label.on_right else (0.005, "left")
    corner = 0.815 if label.on_right else 0.185
    place = dict(transform=axes.transAxes, ha=align, zorder=6)
    axes.text(edge, height + 0.003, label.title, fontsize=9.5, weight="bold", color=label.colour, va="bottom", **place)
    axes.text(edge, height, shorten(printable(label.name)), fontsize=8.5, color="#555555", va="top", **place)
    x, y = low + corner * (high - low), bottom + height * (top - bottom)
    axes.plot([x, label.point[0]], [y, label.point[1]], color=label.leader, linewidth=0.7, alpha=0.6, zorder=1.5)
