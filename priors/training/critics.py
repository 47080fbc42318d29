"""Critics of generated motion and statistics of free runs, for the recipes of the density and the refiner.

Moments hold what the last frames of a free run show of feet, jerk, pace and spread to what the same clips show: a
density of good likelihood, sampled for long, slides on its feet and trembles. Moments hold each number, not how they go
together: a classifier still separates such runs from mocap by poses and by the hips' trajectory. So a critic of free
runs judges their last second, and the density is trained to pass as well, beside being likely. Both are ours. That
critic sees what the classifier of `mapctl measure` does: positions and velocities in the ground frame of the first
frame. The refiner's critic (Wang et al. 2019, section 4.2) sees end effectors, and feet that hardly move magnified.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, ground_speed
from mapctl.joint_roles import find_feet
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT
from mapctl.terms.trial import Trial
from priors.lstm_gmm.network import LstmGmm
from priors.refiner import compute_end_effectors
from priors.training.loop import draw_weights, make_divergence_error
from priors.training.windows import FeatureWindows

PAST_FRAMES = 3
"""Frames of context that a third difference reaches back."""
_CONTEXT = 20  # frames of mocap before a free run; half the window where that is less
_WANDER = 90  # frames at most that a network runs free before the frames that count: faults grow far from the data
_FRAMES = 24  # of a run that are compared, or what the window has left


@dataclass(frozen=True)
class MomentWeights:
    """Weights of the moments: squared log ratios to mocap, as of all but the drift."""

    feet: float = 0.25
    """Planted toes' speed and height. Legs are long levers: with more, the feet's gradient is all that is left."""
    jerk: float = 10.0
    """Each joint's mean jerk."""
    pace: float = 20.0
    """Pace, among slow and among fast windows."""
    spread: float = 5.0
    """Each feature's spread and its change from frame to frame."""
    drift: float = 20.0
    """The features' means over the second half of the runs: squared difference in standard deviations."""


FREE_RUN_MOMENTS = MomentWeights()
"""For runs of a density."""
WINDOW_MOMENTS = MomentWeights(feet=0.25, jerk=2.0, pace=0.0, spread=0.5, drift=0.0)
"""For short windows, as those of a refiner."""


class HistoryBuffer:
    """Windows that earlier weights generated, so that a critic does not forget faults that it once found."""

    def __init__(self, windows: Float[Tensor, "size frames features"]):
        self.windows = windows.clone()

    def keep(self, fresh: Float[Tensor, "batch frames features"], generator: torch.Generator) -> None:
        """Put the fresh ones in place of kept ones."""
        picked = torch.randperm(len(self.windows), generator=generator)[: len(fresh)]
        self.windows[picked] = fresh[: len(picked)]

    def draw(self, count: int, generator: torch.Generator) -> Float[Tensor, "count frames features"]:
        """Draw so many of the kept ones, any of them more than once."""
        return self.windows[torch.randint(len(self.windows), (count,), generator=generator)]


def run_free(
    model: LstmGmm,
    windows: Float[Tensor, "batch frames size"],
    generator: torch.Generator,
    *,
    least: int = 0,
    condition: Float[Tensor, "batch conditions"] | None = None,
) -> tuple[Float[Tensor, "runs generated size"], Float[Tensor, "runs real size"]]:
    """Return free runs that begin with windows, of at least so many frames, and how the windows go on; each after the
    few frames that differences take their past from. The runs are differentiable in the network's weights.
    `condition` is given to the network for each window, as in its `forward`.

    RequestError for windows too short to hold both.
    """
    length = windows.shape[1]
    context = min(_CONTEXT, length // 2)
    frames = min(_FRAMES, length - context)
    if context < PAST_FRAMES:
        raise RequestError(f"free runs are matched in windows of at least {2 * PAST_FRAMES} frames, got {length}")
    state = model.advance(model.start_after(windows[:, 0]), windows[:, 1:context], condition=condition)
    away = int(torch.randint(_WANDER + 1, (1,), generator=generator))
    past = windows[:, :context]
    if away > 0:
        wandered, state = model.sample(state, away, generator, condition=condition)
        past = torch.cat([past, wandered], 1)
    generated, _ = model.sample(state, max(frames, least), generator, condition=condition, differentiable=True)
    real = windows[:, context - PAST_FRAMES : context + frames]
    return torch.cat([past[:, -PAST_FRAMES:], generated], 1), real


def moment_loss(
    generated: Float[Tensor, "batch frames size"], real: Float[Tensor, "batch frames size"], weights: MomentWeights
) -> Tensor:
    """Weighted squared log ratios of the moments; the first frames give differences their past and do not count."""
    ours, theirs = _Moments.of(generated), _Moments.of(real)
    # Feet may be stiller than mocap's, not looser.
    feet = sum(_log_ratio(a, b).clamp(min=0).square() for a, b in zip(ours.feet, theirs.feet, strict=True))
    # The slowest quarter of the windows with mocap's slowest, and so on: walks must not make up for slow runs.
    quarters = zip(*(each.pace.sort().values.chunk(4) for each in (ours, theirs)), strict=True)
    pace = torch.stack([_log_ratio(one, other).mean() for one, other in quarters])
    return (
        weights.feet * feet
        + weights.jerk * _log_ratio(ours.jerk, theirs.jerk).square().mean()
        + weights.pace * pace.square().mean()
        + weights.spread * _log_ratio(ours.spread, theirs.spread).square().mean()
        + weights.spread * _log_ratio(ours.change, theirs.change).square().mean()
        + weights.drift * ((ours.late - theirs.late) / theirs.spread).square().mean()
    )


@dataclass(frozen=True, eq=False)
class _Moments:
    """Moments of a batch of windows; each with a floor that keeps logarithms of stillness finite."""

    feet: tuple[Tensor, Tensor]  # mean squared horizontal speed (m^2/s^2) and height error (m^2) of planted toes
    jerk: Float[Tensor, " joints"]  # mean jerk of each joint, m/s^3
    pace: Float[Tensor, " batch"]  # mean ground speed of each window, m/s
    spread: Float[Tensor, " size"]  # standard deviation of each feature over batch and frames
    change: Float[Tensor, " size"]  # mean change of each feature from frame to frame
    late: Float[Tensor, " size"]  # mean of each feature over the second half of the frames

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


_WIDTH = 128
_LAYERS = ((3, 1), (5, 2), (5, 2), (3, 1))  # kernel and stride
_LEAST_STD = 0.01
_HIPS = CANONICAL.index("hips")
_MEASURED = 256  # captured windows by which the critic's input is standardised
_RATE = 6e-4  # learning rate of the critic
_PENALTY = 0.5  # weight of its squared slope at captured motion
_BATCH = 64  # windows of captured motion an update, and as many of free runs
HISTORY = 512
"""Windows of free runs that are kept for the critic."""
SEEN_FRAMES = 30
"""Frames of a run that the critic sees."""


class CriticTrainer:
    """The critic, its optimiser, and the free runs that it has been shown."""

    def __init__(self, windows: FeatureWindows, *, seed: int):
        """`windows` are of captured motion, and longer than what it sees."""
        self.windows = windows
        shown = self._show_captured(_MEASURED, torch.Generator(windows.features.device).manual_seed(seed))
        self.network = draw_weights(lambda: FreeRunCritic(shown.cpu()), seed).to(torch.get_default_device())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=_RATE, betas=(0.5, 0.99))
        self.history: HistoryBuffer | None = None

    def fill(self, generated: Float[Tensor, "history frames size"]) -> None:
        """Begin to keep free runs for the critic to learn from, with these."""
        self.history = HistoryBuffer(self._show_end(generated))

    def score(self, generated: Float[Tensor, "batch frames size"], generator: torch.Generator) -> Tensor:
        """Return the density's loss, the negative log probability that its runs are taken for captured (Goodfellow et
        al. 2014, section 3), whose gradient goes into what generated them; and keep them instead of earlier ones."""
        assert self.history is not None
        shown = self._show_end(generated)
        self.history.keep(shown.detach(), generator)
        return softplus(-self.network(shown)).mean()

    def learn(self, step: int, updates: int, generator: torch.Generator) -> dict[str, float]:
        """Take updates on captured motion and what is kept; return the mean loss (1.39 where nothing is known), and the
        mean share of windows classified correctly."""
        rows = [self._update(step, generator) for _ in range(updates)]
        return {name: sum(row[name] for row in rows) / len(rows) for name in ("critic", "accuracy")}

    def _update(self, step: int, generator: torch.Generator) -> dict[str, float]:
        assert self.history is not None
        real = self._show_captured(_BATCH, generator)
        for_real, for_generated = self.network(real), self.network(self.history.draw(_BATCH, generator))
        # Cross entropy of both answers (Goodfellow et al. 2014, Eq. 1), and the mean squared slope of the critic at
        # captured motion, by standard deviations (R1 of Mescheder et al. 2018).
        loss = softplus(-for_real).mean() + softplus(for_generated).mean()
        standard = self.network.standardise(real).detach().requires_grad_()
        answer = self.network.score_standardised(standard).sum()
        (slope,) = torch.autograd.grad(answer, standard, create_graph=True)
        total = loss + _PENALTY * slope.square().flatten(1).sum(dim=1).mean()
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        if not math.isfinite(float(total.detach())):
            raise make_divergence_error(step, f"the loss of the critic is {float(total.detach())}")
        self.optimiser.step()
        right = torch.cat([for_real > 0, for_generated < 0]).float().mean()
        return {"critic": float(loss.detach()), "accuracy": float(right)}

    def _show_captured(self, count: int, generator: torch.Generator) -> Float[Tensor, "count seen rows"]:
        return show(self.windows.draw(count, generator).features[:, : SEEN_FRAMES + 1])

    def _show_end(self, generated: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch seen rows"]:
        """Show the last frames of free runs: they are farthest from mocap."""
        return show(generated[:, -SEEN_FRAMES - 1 :])


class FreeRunCritic(nn.Module):
    """Separates captured motion from free runs."""

    mean: Tensor
    std: Tensor

    def __init__(self, rows: Float[Tensor, "windows frames rows"]):
        """`rows` are captured, as `show` returns them; what it sees is measured in their standard deviations."""
        super().__init__()
        self.register_buffer("mean", rows.mean((0, 1)))
        self.register_buffer("std", rows.std((0, 1)).clamp_min(_LEAST_STD))
        widths = (rows.shape[-1], *(_WIDTH,) * (len(_LAYERS) - 1))
        self.layers = nn.ModuleList(
            nn.Conv1d(seen, _WIDTH, kernel, stride, padding=kernel // 2)
            for seen, (kernel, stride) in zip(widths, _LAYERS, strict=True)
        )
        self.last = nn.Linear(2 * _WIDTH, 1)

    def standardise(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, "batch frames rows"]:
        """Put rows into the units that `score_standardised` takes."""
        return (rows - self.mean) / self.std

    def score_standardised(self, standard: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows were captured; by the mean over time and by the worst moment."""
        hidden = standard.transpose(1, 2)
        for layer in self.layers:
            hidden = leaky_relu(layer(hidden), 0.2)
        return self.last(torch.cat([hidden.mean(-1), hidden.amax(-1)], -1))[:, 0]

    def forward(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows of what `show` returns were captured."""
        return self.score_standardised(self.standardise(rows))


def show(features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch frames_less_one rows"]:
    """Encode motion from its second frame on, in metres and m/s on the ground frame of the first: joints about the
    hips, all joints' velocities, and the hips."""
    trial = Trial.of_features(features)
    first = rotations.lift_ground(trial.joints_world[:, :1, _HIPS, ::2]).unsqueeze(-2)
    seen = rotations.rotate_about_y(trial.joints_world - first, -trial.heading[:, :1, None])
    hips, velocity = seen[:, 1:, _HIPS], torch.diff(seen, dim=1) * PRIOR_FPS
    about = seen[:, 1:] - rotations.lift_ground(hips[..., ::2]).unsqueeze(-2)
    return torch.cat([about.flatten(2), velocity.flatten(2), hips], dim=-1)


_END_WIDTH = 128  # units of the first layer and in each direction of the LSTM (the paper's 500)
_AROUND = 2  # frames on either side that its first layer sees (the paper's 0): jitter takes three frames
_SLOW = 0.05  # ground speed of feet, m/s, below which the critic sees it magnified
_FOOT_JOINTS = ("leftFoot", "leftToes", "rightFoot", "rightToes")


class EndEffectorCritic(nn.Module):
    """Separates captured windows from refined ones by end effectors and contact bits (Wang et al. 2019, 4.2)."""

    reach_mean: Tensor
    reach_std: Tensor

    def __init__(self, joints: Sequence[str], *, reach_mean: Tensor, reach_std: Tensor):
        """Take the mean and the spread of `compute_end_effectors`."""
        super().__init__()
        self.joints = tuple(joints)
        self.register_buffer("reach_mean", reach_mean.clone())
        self.register_buffer("reach_std", reach_std.clone())
        self.magnified_columns = [len(joints) + number for number, name in enumerate(joints) if name in _FOOT_JOINTS]
        seen, width = len(reach_mean) + 2 * len(self.magnified_columns) + 2, _END_WIDTH
        self.first = nn.Conv1d(seen, width, 2 * _AROUND + 1)
        self.lstm = nn.LSTM(width, width, batch_first=True, bidirectional=True)
        self.last = nn.Linear(2 * width, 1)

    def forward(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch judged"]:
        """Logits, frame by frame, that a window was captured; for the frames that have enough on either side."""
        ends = compute_end_effectors(features, self.joints)
        # A foot that slides by 10 cm/s is a twentieth of the spread of feet's speeds, and what every viewer sees.
        ground = ends.unflatten(-1, (-1, 3))[:, :, self.magnified_columns, ::2]
        magnified = 0.5 * torch.asinh(ground / _SLOW).flatten(2)
        bits = 2 * LAYOUT.pick(features, "contacts")[:, 1:] - 1
        seen = torch.cat([(ends - self.reach_mean) / self.reach_std, bits, magnified], dim=-1).transpose(1, 2)
        hidden, _ = self.lstm(leaky_relu(self.first(seen), 0.2).transpose(1, 2))
        return self.last(hidden)[..., 0]
