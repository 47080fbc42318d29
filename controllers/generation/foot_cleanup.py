"""Finish a generated motion: feet that its own contact labels call planted stand, and the rest follows (section 4.3).

A sliding-window MAP over the latents of the motion: the noise prior takes the tremble away, footing the slide, and
closeness keeps what the motion does. Works piece by piece in memory that does not grow.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Stature
from mapctl.contacts import STEADY, steadied
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, Place
from mapctl.problem.ledger import Ledger
from mapctl.problem.receding_horizon import Committed, WindowSettings, WindowSolver
from mapctl.problem.window_solvers import GuidedMethod
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms import Closeness, Footing, Noise, Term


@dataclass(frozen=True)
class FinishSettings:
    """Sigmas and search of the finishing pass; the terms' own docstrings give the meaning."""

    sigma_noise: float = 1.0
    """Of the noise prior: above 1 leaves more of the motion's own tremble."""
    sigma_pose: float = Closeness.sigma_pose
    """Distance of joints from the motion's, metres."""
    sigma_way: float = Closeness.sigma_way
    """Way over the ground within a window, metres."""
    sigma_turn: float = Closeness.sigma_turn
    """Turn within a window, radians."""
    footing: Footing = field(default_factory=lambda: Footing(sigma_speed=0.06))
    """Planted feet. Mocap's own move a little: feet that stood still would be told from them."""
    window: WindowSettings = field(default_factory=WindowSettings)
    """How windows are laid."""
    share: float = GuidedMethod.share
    """Of the motion's noise that the search starts with."""

    def seen_by(self, person: Stature) -> "FinishSettings":
        """The same for somebody of this size, in metres of the prior's size."""
        return self if person.scale == 1.0 else replace(self, footing=person.footing(self.footing))


def finish(
    prior: Any,
    pieces: Iterable[Float[Tensor, "_ size"]],
    *,
    frames: int,
    state: Any,
    generator: torch.Generator,
    settings: FinishSettings | None = None,
    skeleton: Skeleton = CANONICAL,
) -> Iterator[Float[Tensor, "_ size"]]:
    """Finished features of the first `frames` of consecutive pieces, their contact labels steadied.

    `state` is the density's before the first frame (batch of one). Windows look ahead, so the pieces must hold
    `settings.window.frames` more than are asked for; RequestError where they do not.
    """
    settings = settings or FinishSettings()
    still = torch.zeros(0, skeleton.num_joints, 3)
    done = Committed(state, Place.origin(), state.previous.float(), still, torch.zeros(0, LAYOUT.continuous))
    waiting, left = torch.zeros(0, LAYOUT.size), frames
    for piece in pieces:
        waiting = torch.cat([waiting, piece.float()])
        while left > 0 and len(waiting) >= settings.window.frames:
            count = min(settings.window.frames - settings.window.overlap, left)
            window = _with_steady_contacts(done.features, waiting[: settings.window.frames])
            done = _window(prior, done, window, count, settings, skeleton, generator)
            yield done.features[-count:]
            waiting, left, done = waiting[count:], left - count, _forgetting(done)
    if left > 0:
        raise RequestError(
            f"finishing needs {left + settings.window.frames - len(waiting)} more frames than it was given"
        )


def _window(
    prior: Any,
    done: Committed,
    window: Float[Tensor, "frames size"],
    count: int,
    settings: FinishSettings,
    skeleton: Skeleton,
    generator: torch.Generator,
) -> Committed:
    """`done` and `count` more frames; a window without a finite solution is left as it was."""
    closeness = Closeness(
        window, sigma_pose=settings.sigma_pose, sigma_way=settings.sigma_way, sigma_turn=settings.sigma_turn
    )
    terms: tuple[Term, ...] = Noise(settings.sigma_noise), closeness, settings.footing
    method = GuidedMethod(window, share=settings.share)
    solver = WindowSolver(prior, settings.window, skeleton, method=method)
    following, _ = solver.solve(done, lambda first, frames: terms, len(done.features) + count, generator=generator)
    return following


def _forgetting(done: Committed) -> Committed:
    """Without all that no later window looks at, and moved to the origin, where single precision is finest."""
    here = done.place.position_xz
    joints = done.joints_world - torch.stack([here[0], here.new_zeros(()), here[1]])
    return replace(
        done,
        features=done.features[-STEADY:],
        ledger=Ledger(),
        windows=(),
        joints_world=joints,
        place=Place(torch.zeros_like(here), done.place.heading),
    )


def _with_steady_contacts(
    before: Float[Tensor, "past size"], window: Float[Tensor, "frames size"]
) -> Float[Tensor, "frames size"]:
    """The window with contacts, and gaps in them, of less than STEADY frames gone."""
    bits = LAYOUT.pick(torch.cat([before, window]), "contacts") > 0.5
    steady = steadied(bits)[len(before) :]
    return torch.cat([window[:, : LAYOUT.continuous], steady.to(window.dtype)], dim=-1)
