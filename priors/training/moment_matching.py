"""Free runs held to the data's own moments: what likelihood alone leaves to chance.

A frame that is likely given mocap is not yet a frame that leads on: sampled for long, a density of good likelihood
slides on its feet and trembles, and no frame of the data shows it how that comes about. Here the network runs free
after a stretch of mocap, and what the last frames of the run, made by reparametrised draws, show of feet, jerk, pace
and spread is compared with what the same clips show. Ours; the paper leaves all of it to the refiner.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, ground_speed
from mapctl.joint_roles import find_feet
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT
from mapctl.terms.trial import Trial
from priors.checkpoints import require_at_least
from priors.lstm_gmm.network import LstmGmm

PAST_FRAMES = 3
"""Frames of context that a third difference reaches back."""


@dataclass(frozen=True)
class MatchingSettings:
    """When and how free runs are held to the data."""

    begin: float = 0.75
    """Share of the steps after which it sets in: before, the network cannot run free yet. 1 leaves it out."""
    every: int = 4
    """Steps from one comparison to the next: at each step feet are stiller still, but samples differ from mocap."""
    batch: int = 32
    """Free runs of a comparison; the first windows of the step's batch."""
    context: int = 20
    """Frames of mocap before each run; half the window where that is less."""
    wander: int = 90
    """Frames at most that a network has run free before the frames that count; drawn for each step. Faults grow far
    from the data, and a network mended only near it drifts off into standing still."""
    frames: int = 24
    """Length of a run, or what the window has left."""
    feet: float = 0.25
    """Weight of the planted toes' speed and height: squared log ratios to mocap, as of all but the drift. Legs are
    long levers: at the weight of the others, the feet's gradient is all that is left of them."""
    jerk: float = 10.0
    """Weight of each joint's mean jerk."""
    pace: float = 20.0
    """Weight of the pace, among slow and among fast windows."""
    spread: float = 5.0
    """Weight of each feature's spread and of its change from frame to frame."""
    drift: float = 20.0
    """Weight of the features' means over the second half of the runs: squared difference in standard deviations."""

    def __post_init__(self):
        require_at_least(self, PAST_FRAMES, "batch", "context", "frames")
        require_at_least(self, 1, "every")


def run_free(
    model: LstmGmm,
    windows: Float[Tensor, "batch frames size"],
    settings: MatchingSettings,
    generator: torch.Generator,
    *,
    least: int = 0,
    condition: Float[Tensor, "batch conditions"] | None = None,
) -> tuple[Float[Tensor, "runs made size"], Float[Tensor, "runs real size"]]:
    """Free runs that begin with windows, of at least so many frames, and how the windows go on; each after the few
    frames that differences take their past from. The runs are differentiable in the network's weights. `condition` is
    given to the network for each window, as in its `forward`.

    RequestError for windows too short to hold both.
    """
    length = windows.shape[1]
    context = min(settings.context, length // 2)
    frames = min(settings.frames, length - context)
    if context < PAST_FRAMES:
        raise RequestError(f"free runs are matched in windows of at least {2 * PAST_FRAMES} frames, got {length}")
    windows = windows[: settings.batch]
    told = None if condition is None else condition[: settings.batch]
    state = model.advance(model.start_after(windows[:, 0]), windows[:, 1:context], condition=told)
    drawn = torch.randint(settings.wander + 1, (1,), generator=generator)
    past, away = windows[:, :context], int(drawn)
    if away > 0:
        wandered, state = model.sample(state, away, generator, condition=told)
        past = torch.cat([past, wandered], 1)
    made, _ = model.draw(state, max(frames, least), generator, condition=told)
    real = windows[:, context - PAST_FRAMES : context + frames]
    return torch.cat([past[:, -PAST_FRAMES:], made], 1), real


def moment_loss(
    made: Float[Tensor, "batch frames size"], real: Float[Tensor, "batch frames size"], settings: MatchingSettings
) -> Tensor:
    """Weighted squared log ratios of the moments; the first frames give differences their past and do not count."""
    ours, theirs = _Moments.of(made), _Moments.of(real)
    # Feet may be stiller than mocap's, not looser.
    feet = sum(_log_ratio(a, b).clamp(min=0).square() for a, b in zip(ours.feet, theirs.feet, strict=True))
    pace = torch.stack([_log_ratio(made_, real_).mean() for made_, real_ in _pair_by_pace(ours.pace, theirs.pace)])
    return (
        settings.feet * feet
        + settings.jerk * _log_ratio(ours.jerk, theirs.jerk).square().mean()
        + settings.pace * pace.square().mean()
        + settings.spread * _log_ratio(ours.spread, theirs.spread).square().mean()
        + settings.spread * _log_ratio(ours.change, theirs.change).square().mean()
        + settings.drift * ((ours.late - theirs.late) / theirs.spread).square().mean()
    )


@dataclass(frozen=True, eq=False)
class _Moments:
    """What a batch of windows shows; each with a floor that keeps logarithms of stillness finite."""

    feet: tuple[Tensor, Tensor]
    """Mean squared horizontal speed (m^2/s^2) and height error (m^2) of planted toes."""
    jerk: Float[Tensor, " joints"]
    """Mean jerk of each joint, m/s^3."""
    pace: Float[Tensor, " batch"]
    """Mean ground speed of each window, m/s."""
    spread: Float[Tensor, " size"]
    """Standard deviation of each feature over batch and frames."""
    change: Float[Tensor, " size"]
    """Mean change of each feature from frame to frame."""
    late: Float[Tensor, " size"]
    """Mean of each feature over the second half of the frames."""

    @staticmethod
    def of(features: Float[Tensor, "batch frames size"]) -> "_Moments":
        trial = Trial.of_features(features)
        continuous, bits = features[..., : LAYOUT.continuous], trial.contacts
        joints = trial.joints_world
        toes = joints[:, :, list(find_feet(CANONICAL))]
        steps = torch.diff(toes[..., ::2], dim=1).square().sum(-1) * trial.fps**2
        held = (bits[:, 1:] & bits[:, :-1])[:, PAST_FRAMES - 1 :].to(features.dtype)
        lift = (toes[:, 1:, :, 1] - TOE_REST_HEIGHT).square()
        jerk = torch.sqrt(torch.diff(joints, n=3, dim=1).square().sum(-1) + 1e-12) * trial.fps**3
        return _Moments(
            feet=(
                _masked_mean(held, steps[:, PAST_FRAMES - 1 :]) + 1e-4,
                _masked_mean(held, lift[:, PAST_FRAMES - 1 :]) + 1e-5,
            ),
            jerk=jerk.mean((0, 1)) + 1.0,
            pace=ground_speed(features[:, PAST_FRAMES:]).mean(1) + 0.05,
            spread=continuous[:, PAST_FRAMES:].flatten(0, 1).std(0) + 1e-3,
            change=torch.diff(continuous, dim=1)[:, PAST_FRAMES - 1 :].abs().mean((0, 1)) + 1e-4,
            late=continuous[:, continuous.shape[1] // 2 :].mean((0, 1)),
        )


def _masked_mean(held: Tensor, values: Tensor) -> Tensor:
    return (held * values).sum() / held.sum().clamp(min=1)


def _log_ratio(ours: Tensor, theirs: Tensor) -> Tensor:
    return torch.log(ours) - torch.log(theirs)


def _pair_by_pace(ours: Tensor, theirs: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Our slowest quarter of the windows with mocap's slowest, and so on: walks must not make up for slow runs."""
    return list(zip(ours.sort().values.chunk(4), theirs.sort().values.chunk(4), strict=True))
