"""Styles of a --dna option: motion files of any known rig, and classes that a tweener's weights know by name."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from controllers.inbetweening.proposers import AutoInbetweener
from mapctl import formats, motion_dna
from mapctl.commands.shared.inputs import read_motion
from mapctl.errors import RequestError
from mapctl.motion_dna import MotionDna
from mapctl.protocols import Inbetweener
from priors.tweening.inbetweener import Tweener
from priors.tweening.styles import Style, mix_styles, pick_class

METHODS = ("auto", "tweener")
"""Methods that know styles."""


@dataclass(frozen=True, eq=False)
class Example:
    """One of the styles that are asked for."""

    name: str
    """A file, or a class."""
    dna: MotionDna | None
    """Poses of the file; None for a class."""


def read_dna(text: str | None, method: str) -> tuple[Example, ...]:
    """Read the motion files that a --dna option names; what is none is a class. RequestError for methods without
    styles, and for files that no poses can be taken of."""
    if text is None:
        return ()
    if method not in METHODS:
        raise RequestError(f"--method {method} knows no style; leave --dna out or take --method tweener")
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise RequestError(f"--dna takes motion files and classes with a comma between two, got {text!r}")
    return tuple(_read_example(name) for name in names)


def _read_example(name: str) -> Example:
    path = Path(name)
    if not path.is_file() and path.suffix.lower() not in formats.READERS:
        return Example(name, None)
    motion = read_motion(path, None, quiet=True)
    try:
        return Example(path.name, motion_dna.of(motion))
    except RequestError as error:
        raise RequestError(f"{name} tells no style: {error}") from error


def find_styles(tweener: Tweener, examples: Sequence[Example]) -> list[Style]:
    """Find the style of each example; RequestError for a class that the weights do not know."""
    return [
        pick_class(tweener.classes, example.name)
        if example.dna is None
        else tweener.encode_style(example.dna, example.name)
        for example in examples
    ]


def tell_style(inbetweener: Inbetweener, examples: Sequence[Example]) -> Inbetweener:
    """Tell a tweener the styles of examples, all together; without any, and anyone else, stays as it is."""
    if not examples or not isinstance(inbetweener, Tweener):
        return inbetweener
    return inbetweener.in_style(mix_styles(find_styles(inbetweener, examples)))


def restyle(inbetweener: Inbetweener, style: Style) -> Inbetweener:
    """Return an in-betweener whose tweener, if it has one or is one, moves in another style."""
    if isinstance(inbetweener, AutoInbetweener) and inbetweener.tweener is not None:
        return replace(
            inbetweener, network=restyle(inbetweener.network, style), tweener=restyle(inbetweener.tweener, style)
        )
    return inbetweener.in_style(style) if isinstance(inbetweener, Tweener) else inbetweener


def find_tweener(inbetweener: Inbetweener) -> Tweener | None:
    """Find the tweener that an in-betweener is or has."""
    own = inbetweener.tweener if isinstance(inbetweener, AutoInbetweener) else inbetweener
    return own if isinstance(own, Tweener) else None
