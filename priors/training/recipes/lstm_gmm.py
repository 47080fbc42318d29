"""Training of the LSTM-GMM: Wang et al. 2019, section 4.1.3, with departures.

Windows of clips with noise on the inputs; loss is the negative log density of the next frame (Eq. 8).

What a density is worth on held-out clips: likelihood, and whether, sampled for long, it stays a person
moving as the data do.

A critic of the density's free runs, which joins the last steps of training.

Moments (see moment_matching) hold each number of a free run to the data, not how they go together: a classifier still
separates such runs from mocap by poses and by the hips' trajectory. The critic judges a second of a free run, far from
the mocap that it began with; the density is made likelier to pass, beside being likely. Ours. It sees what the
classifier of `mapctl measure` does: positions and velocities in the ground frame of the first frame. Feet that hardly
move are not magnified, as for the refiner's critic: by the noise of their single frames, which a mixture draws and no
weights take away, it wins at once.
"""

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, one_hot, softplus

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, integrate_root, mirror_features
from mapctl.metrics import compute_reference
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.protocols import DataLimits, InitialStates
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial
from priors import stitcher
from priors.checkpoints import require_at_least
from priors.lstm_gmm import density
from priors.lstm_gmm.density import PACE_LABELS, Labels
from priors.lstm_gmm.network import NOISE_UNIT, LstmGmm, LstmGmmConfig, LstmState
from priors.training.augment import add_copies, add_splices, drop_splices, hide_splices
from priors.training.data import Corpus, Split, follow_paces, measure_pace_changes
from priors.training.loop import (
    Export,
    Gathered,
    GradientTrainer,
    HistoryBuffer,
    Progress,
    Recipe,
    Row,
    draw_weights,
    make_divergence_error,
    make_generator,
    use_device,
)
from priors.training.moment_matching import MatchingSettings, moment_loss, run_free
from priors.training.windows import FeatureWindows


def summarise_states(features: Float[Tensor, "frames size"]) -> dict[str, float]:
    """Summarise mean speed (m/s), mean root height (m) and mean standard deviation of the joint rotations (rad)."""
    return {
        "speed": float(ground_speed(features).mean()),
        "height": float(LAYOUT.pick(features, "root_height").mean()),
        "pose": float(LAYOUT.pick(features, "joint_rotations").std(0).mean()),
    }


_SECOND = PRIOR_FPS  # frames
_WARM_UP_FRAMES = 40  # frames of a clip before a start; the memory has settled by then


def select_initial_states(
    model: LstmGmm,
    corpus: Corpus,
    *,
    count: int,
    generator: torch.Generator,
    labels: Float[Tensor, "clips labels"] | None = None,
) -> InitialStates:
    """`count` moments of clips, or as many as there are clips; one a clip.

    Each combination of `labels` (1 where a label holds for a clip; default: none hold) gets its part of them by its
    frames, one at least where there are enough, spread evenly over its speeds.
    """
    clips = [i for i, length in enumerate(corpus.lengths) if length > _WARM_UP_FRAMES + _SECOND]
    features = corpus.clips()
    shuffled = [clips[i] for i in torch.randperm(len(clips), generator=generator).tolist()]
    ends = [
        _WARM_UP_FRAMES
        + int(torch.randint(len(features[i]) - _WARM_UP_FRAMES - _SECOND // 2, (1,), generator=generator))
        for i in shuffled
    ]
    speeds = torch.stack(
        [ground_speed(features[i][end - _SECOND : end]).mean() for i, end in zip(shuffled, ends, strict=True)]
    )
    strata = _number_strata(labels, len(features))
    frames = torch.tensor(corpus.lengths, dtype=torch.float32)
    frames_of, of_starts = torch.zeros(int(strata.max()) + 1).index_add_(0, strata, frames), strata[shuffled]
    clips_of = torch.bincount(of_starts, minlength=len(frames_of))
    picked = []
    for stratum, share in enumerate(_share_out(frames_of.tolist(), clips_of, count)):
        members = torch.nonzero(of_starts == stratum)[:, 0]
        picked += members[_select_by_speed(speeds[members], share)].tolist() if share else []
    states = [_state_after(model, features[shuffled[k]][: ends[k]]) for k in picked]
    state = LstmState(
        torch.cat([s.last_frame for s in states]),
        torch.cat([s.hidden for s in states], 1),
        torch.cat([s.cell for s in states], 1),
    )
    names = tuple(corpus.names[shuffled[k]] for k in picked)
    weights = _compute_weights(corpus, strata, speeds[picked], of_starts[picked])
    return InitialStates(state, speeds[picked], names, weights)


def measure_data_limits(corpus: Corpus) -> DataLimits:
    """Percentiles of one-second means of speed and of the turning of the travel direction."""
    speeds, turns = [], []
    for clip in corpus.clips():
        if len(clip) <= 2 * _SECOND:
            continue
        ground, _ = integrate_root(clip.double(), GroundPose.origin(torch.float64))
        velocity = ground[_SECOND:] - ground[:-_SECOND]  # metres in one second
        pace = velocity.norm(dim=-1)
        direction = torch.atan2(velocity[:, 0], velocity[:, 1])
        turn = rotations.wrap_angle(direction[_SECOND:] - direction[:-_SECOND])
        speeds.append(pace)
        turns.append(turn.abs()[pace[_SECOND:] > 0.5])
    speeds, turns = torch.cat(speeds), torch.cat(turns)
    turn_rate = float(turns.quantile(0.995)) if len(turns) else 0.0  # nobody may walk in the data
    return DataLimits(float(speeds.quantile(0.01)), float(speeds.quantile(0.99)), turn_rate)


def _number_strata(labels: Tensor | None, clips: int) -> Int[Tensor, " clips"]:
    """Number of each clip's combination of labels."""
    if labels is None or labels.shape[1] == 0:
        return torch.zeros(clips, dtype=torch.long)
    return torch.unique(labels, dim=0, return_inverse=True)[1]


def _share_out(frames: Sequence[float], clips: Int[Tensor, " strata"], count: int) -> list[int]:
    """How many starts each stratum gets: one after the other goes to the one with most frames for each of its starts
    so far (Adams' rule of apportionment), so that none is left without while there are enough.
    """
    given = [0] * len(frames)
    for _ in range(min(count, int(clips.sum()))):
        open_ = [k for k in range(len(frames)) if given[k] < clips[k]]
        chosen = max(open_, key=lambda k: (given[k] == 0, frames[k] / max(1, given[k])))
        given[chosen] += 1
    return given


def _select_by_speed(speeds: Tensor, count: int) -> list[int]:
    """Indices whose speeds lie evenly between the slowest and the fastest."""
    low, high = speeds.quantile(0.02), speeds.quantile(0.98)
    free = torch.ones(len(speeds), dtype=torch.bool)
    picked = []
    # Half at even quantiles (common speeds), half at even steps of speed (rare ones too).
    rare = count // 2
    wanted = torch.cat([torch.quantile(speeds, _spread(count - rare)), low + (high - low) * _spread(rare)])
    for value in wanted[: int(free.sum())]:
        nearest = torch.where(free, (speeds - value).abs(), torch.inf).argmin()
        free[nearest] = False
        picked.append(int(nearest))
    return picked


def _spread(count: int) -> Float[Tensor, " count"]:
    """The middles of so many equal parts of 0 to 1."""
    return (torch.arange(count) + 0.5) / max(1, count)


def _compute_weights(
    corpus: Corpus, strata: Int[Tensor, " clips"], speeds: Float[Tensor, " starts"], of_starts: Int[Tensor, " starts"]
) -> Float[Tensor, " starts"]:
    """How much of the data is nearest to each start, clip by clip, every frame counting the same: of its stratum the
    one of the nearest speed, or of any where its stratum has none.
    """
    pace = torch.stack([ground_speed(clip).mean() for clip in corpus.clips()])
    apart = (pace[:, None] - speeds).abs().double()
    nearest = (apart + 1e6 * (strata[:, None] != of_starts)).argmin(-1)
    frames = torch.zeros(len(speeds)).index_add_(0, nearest, torch.tensor(corpus.lengths, dtype=torch.float32))
    return frames / frames.sum()


def _state_after(model: LstmGmm, clip: Float[Tensor, "frames size"]) -> LstmState:
    """Return the state after the whole clip."""
    with torch.no_grad():
        state = model.start_after(clip[:1])
        return model.advance(state, clip[1:].unsqueeze(0))


_WIDTH = 128
_LAYERS = ((3, 1), (5, 2), (5, 2), (3, 1))  # kernel and stride
_LEAST_STD = 0.01
_HIPS = CANONICAL.index("hips")
_MEASURED = 256  # captured windows by which the critic's input is standardised
_WARM_UP = 20  # steps in which the density's learning rate rises
_FALL = 0.3  # share of the steps in which it falls to nothing


@dataclass(frozen=True)
class CriticSettings:
    """When the critic joins, how it learns, and how the density does from then on."""

    learning_rate: float = 3e-4
    """Of the density in these steps; it falls to nothing over the last three tenths."""
    every: int = 2
    """Steps from one free run to the next."""
    frames: int = 30
    """Frames of a run that it sees."""
    weight: float = 1.0
    """Weight of its loss, whose gradient is clipped by itself."""
    rate: float = 6e-4
    """Learning rate of the critic."""
    updates: int = 2
    """Updates of the critic in a step."""
    head_start: int = 400
    """Updates of the critic before the density is trained by it."""
    batch: int = 64
    """Windows of captured motion an update, and as many of free runs."""
    history: int = 512
    """Windows of free runs that are kept for it."""
    penalty: float = 0.5
    """Weight of its squared slope at captured motion."""
    average: float = 0.995
    """Share of the past in the running mean of the density's weights, which is what is kept."""

    def __post_init__(self):
        require_at_least(self, 0, "head_start")
        require_at_least(self, 1, "every", "updates", "batch", "history")
        require_at_least(self, 2, "frames")

    def compute_learning_rate(self, step: int, steps: int) -> float:
        """That of the density in a step of so many with the critic."""
        rise = min(1.0, (step + 1) / _WARM_UP)
        return self.learning_rate * rise * min(1.0, (steps - step) / max(1.0, _FALL * steps))


class FreeRunJudge:
    """The critic, its optimiser, and the free runs that it has been shown."""

    def __init__(self, settings: CriticSettings, windows: FeatureWindows, *, seed: int):
        """`windows` are of captured motion, and longer than what it sees."""
        self.settings, self.windows = settings, windows
        shown = self._show_captured(_MEASURED, torch.Generator(windows.features.device).manual_seed(seed))
        self.network = draw_weights(lambda: FreeRunCritic(shown.cpu()), seed).to(torch.get_default_device())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.rate, betas=(0.5, 0.99))
        self.history: HistoryBuffer | None = None

    def fill(self, made: Float[Tensor, "history frames size"]) -> None:
        """Begin to keep free runs for the critic to learn from, with these."""
        self.history = HistoryBuffer(self._show_end(made))

    def score(self, made: Float[Tensor, "batch frames size"], generator: torch.Generator) -> Tensor:
        """Return the density's loss, whose gradient goes into what generated the motion; and keep the free runs in
        place of earlier ones."""
        assert self.history is not None
        shown = self._show_end(made)
        self.history.keep(shown.detach(), generator)
        return self.settings.weight * compute_generator_loss(self.network(shown))

    def learn(self, step: int, updates: int, generator: torch.Generator) -> dict[str, float]:
        """Take updates on captured motion and what is kept; return the mean loss (1.39 where nothing is known), and the
        mean share of windows classified correctly."""
        rows = [self._update(step, generator) for _ in range(updates)]
        return {name: sum(row[name] for row in rows) / len(rows) for name in ("critic", "told")}

    def _update(self, step: int, generator: torch.Generator) -> dict[str, float]:
        assert self.history is not None
        count = self.settings.batch
        real = self._show_captured(count, generator)
        for_real, for_made = self.network(real), self.network(self.history.draw(count, generator))
        loss = compute_critic_loss(for_real, for_made)
        total = loss + self.settings.penalty * compute_gradient_penalty(self.network, real)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        if not math.isfinite(float(total.detach())):
            raise make_divergence_error(step, f"the loss of the critic is {float(total.detach())}")
        self.optimiser.step()
        right = torch.cat([for_real > 0, for_made < 0]).float().mean()
        return {"critic": float(loss.detach()), "told": float(right)}

    def _show_captured(self, count: int, generator: torch.Generator) -> Float[Tensor, "count seen rows"]:
        return show(self.windows.draw(count, generator).features[:, : self.settings.frames + 1])

    def _show_end(self, made: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch seen rows"]:
        """Show the last frames of free runs: they are farthest from mocap."""
        return show(made[:, -self.settings.frames - 1 :])


class FreeRunCritic(nn.Module):
    """Tells captured motion from free runs."""

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
        """Put rows into the units that `judge` takes."""
        return (rows - self.mean) / self.std

    def judge(self, standard: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows were captured; by the mean over time and by the worst moment."""
        hidden = standard.transpose(1, 2)
        for layer in self.layers:
            hidden = leaky_relu(layer(hidden), 0.2)
        return self.last(torch.cat([hidden.mean(-1), hidden.amax(-1)], -1))[:, 0]

    def forward(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows of what `show` returns were captured."""
        return self.judge(self.standardise(rows))


def show(features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch frames_less_one rows"]:
    """Encode motion from its second frame on, in metres and m/s on the ground frame of the first: joints about the
    hips, all joints' velocities, and the hips."""
    trial = Trial.of_features(features)
    first = rotations.lift_ground(trial.joints_world[:, :1, _HIPS, ::2]).unsqueeze(-2)
    seen = rotations.rotate_about_y(trial.joints_world - first, -trial.heading[:, :1, None])
    hips, velocity = seen[:, 1:, _HIPS], torch.diff(seen, dim=1) * PRIOR_FPS
    about = seen[:, 1:] - rotations.lift_ground(hips[..., ::2]).unsqueeze(-2)
    return torch.cat([about.flatten(2), velocity.flatten(2), hips], dim=-1)


def compute_critic_loss(real: Float[Tensor, " batch"], made: Float[Tensor, " others"]) -> Tensor:
    """Cross entropy of both answers in nats; 1.39 where nothing is known (Goodfellow et al. 2014, Eq. 1)."""
    return softplus(-real).mean() + softplus(made).mean()


def compute_generator_loss(made: Float[Tensor, " batch"]) -> Tensor:
    """Negative log probability that what was made is taken for captured (Goodfellow et al. 2014, section 3)."""
    return softplus(-made).mean()


def compute_gradient_penalty(critic: FreeRunCritic, real: Float[Tensor, "batch frames rows"]) -> Tensor:
    """Mean squared slope of the critic at captured motion (R1 of Mescheder et al. 2018), by standard deviations."""
    standard = critic.standardise(real).detach().requires_grad_()
    (slope,) = torch.autograd.grad(critic.judge(standard).sum(), standard, create_graph=True)
    return slope.square().flatten(1).sum(dim=1).mean()


_SETTLING_FRAMES = 300


def measure_free_runs(
    model: LstmGmm, corpus: Corpus, *, runs: int = 8, frames: int = 1500, temperature: float = 1.0, seed: int = 0
) -> dict[str, float]:
    """Speed, height and pose variation of free runs, each as a ratio to the corpus, and the slowest run's last speed.

    Runs begin after the first two seconds of clips; their first ten seconds are not counted.
    """
    clips = [clip for clip in corpus.clips() if len(clip) > 60]
    clips = [clips[i * len(clips) // runs % len(clips)] for i in range(runs)]
    state = model.start_after(torch.stack([clip[0] for clip in clips]).to(model.mean.device))
    state = model.advance(state, torch.stack([clip[1:60] for clip in clips]).to(model.mean.device))
    features, _ = model.sample(state, frames, make_generator(seed), temperature=temperature)
    settled = features[:, min(_SETTLING_FRAMES, frames // 2) :].cpu()
    own, wanted = summarise_states(settled.flatten(0, 1)), summarise_states(corpus.features)
    result = {f"free_run_{name}_ratio": own[name] / wanted[name] for name in own}
    result["free_run_slowest_m_s"] = float(ground_speed(settled[:, -150:]).mean(-1).min())
    result["free_run_finite"] = float(torch.isfinite(features).all())
    return result


def measure_quality(model: LstmGmm, parts: Split) -> dict[str, Any]:
    """Measure the quality of a finished network, for its card."""
    return {
        "test_nats_per_frame": compute_validation_nats(model, parts.test),
        "windows": compute_window_nats(model, (parts.validation, parts.test)),
        "mocap": _measure_mocap(parts),
        "data": summarise_states(parts.train.features),
    }


def _measure_mocap(parts: Split) -> dict[str, dict[str, float]]:
    """What the clips kept from training show in every measure: mean, 2nd and 98th percentile (NaN left out)."""
    held = [decode(clip, GroundPose.origin()) for part in (parts.validation, parts.test) for clip in part.clips()]
    table = {name: spread._asdict() for name, spread in compute_reference(held).items()}
    return {name: row for name, row in table.items() if not math.isnan(row["mean"])}


def compute_validation_nats(model: LstmGmm, corpus: Corpus, frames: int = 100) -> float:
    """Mean negative log density a frame over the first frames of every clip, clean inputs, from an empty memory."""
    total, count = 0.0, 0
    with torch.no_grad():
        for clip in corpus.clips():
            clip = clip[:frames].unsqueeze(0).to(model.mean.device)
            nats = -model.log_prob(clip[:, 1:], model.start_after(clip[:, 0]))
            total, count = total + nats.sum().item(), count + nats.numel()
    return total / count


def compute_window_nats(model: LstmGmm, corpora: Iterable[Corpus]) -> dict[str, float]:
    """Log density a frame, physical units, of motion as wrong as a proposal is: mean over windows, and the value that
    98 % of them reach. By it a density's trust is told (see mapctl.problem.density_selection); clips begin with an
    empty memory.
    """
    blurred, found = model.cpu().with_observation_noise(density_selection.proposal_sigma()), []
    with torch.no_grad():
        for clip in (clip for corpus in corpora for clip in corpus.clips() if len(clip) > 1):
            nats = blurred.log_prob(clip[None, 1:], blurred.start_after(clip[:1]))[0]
            parts = density_selection.to_physical_log_density(nats, blurred.std).split(
                density_selection.SELECTION_WINDOW
            )
            found += [
                part.mean() for part in parts if len(part) == density_selection.SELECTION_WINDOW or len(parts) == 1
            ]
    values = torch.stack(found)
    return {"mean": float(values.mean()), "p2": float(values.quantile(0.02))}


def compute_feature_statistics(features: Float[Tensor, "frames size"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of features and their mirror image; floors keep held joints from exploding.

    Rotations are held to at least 0.01 rad (0.6 degrees), displacements to 1 mm; contact bits map to -1 and 1.
    """
    both = torch.cat([features, mirror_features(features)])
    mean, std = both.mean(0), both.std(0)
    floor = torch.full_like(std, 0.01)
    floor[LAYOUT.slices["root_displacement_heading"]] = 0.001
    floor[LAYOUT.slices["heading_change"]] = 0.002
    for values in (mean, floor, std):
        values[LAYOUT.slices["contacts"]] = 0.5
    return mean, torch.maximum(std, floor)


_KEEP_GROUP_PROBABILITY = 0.7
_MOST = 0.3  # change of tempo or stride, beyond which walks are no longer likely
_LEAST_RUNS = 4  # free runs that are compared: slow ones with slow ones, by quarters
_UNTOLD = {"critic": 2 * math.log(2), "told": 0.5}  # of a critic that knows nothing


@dataclass(frozen=True)
class TrainingSettings:
    """How a density is trained."""

    steps: int = 20_000
    """Optimiser steps in all."""
    batch: int = 128
    """Windows a step."""
    window: int = 50
    """Frames a window."""
    learning_rate: float = 1e-3
    """At the start."""
    gradient_clip: float = 5.0
    """The gradient's norm is clipped to this."""
    input_noise: float = 0.05
    """Standard deviation of the noise on normalised inputs (section 4.1.3)."""
    noise_range: float = 4.0
    """Each window draws its noise level log-uniformly between `input_noise` and this many times it; 1 is the paper.
    A network that knows the level is shown all levels down to none, low ones more often."""
    bit_flips: float = 0.02
    """Share of input contact bits that are flipped."""
    copies: int = 0
    """Copies of each clip at other tempos and with other strides, for corpora of a few minutes."""
    tempo: float = 0.15
    """Largest change of a copy's tempo, as a share: 0.15 plays at 0.85 to 1.15 of the speed."""
    strides: float = 0.1
    """Largest change of how far a copy's feet and hips go, as a share: as of a body with longer or shorter legs."""
    standing_share: float = 1.0
    """Share of the windows in which nobody goes anywhere that are drawn: where most of the motion stands, a density
    that sees all of them stands fast, and is hard to steer into a walk."""
    weight_decay: float = 1e-4
    """Decoupled."""
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    """Free runs held to the data's moments."""
    critic_steps: int = 0
    """Last steps of the run, in which a critic judges free runs; 0 leaves it out."""
    critic: CriticSettings = field(default_factory=CriticSettings)
    """How that critic learns."""
    untold: float = 0.5
    """Share of the windows without labels; the others show each group (gait, style) with probability 0.7."""
    bfloat16: bool = False
    """The network computes in bfloat16, weights and loss stay in float32: faster where the processor has it."""
    seed: int = 1
    """Seed of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch", "window")
        require_at_least(self, 0, "copies", "critic_steps")
        for name, change in (("tempo", self.tempo), ("strides", self.strides)):
            if not 0 <= change <= _MOST:
                raise RequestError(f"{name} must lie between 0 and {_MOST}, got {change:g}")
        if self.critic_steps >= self.steps:
            raise RequestError(
                f"a critic joins the last steps of a run: {self.critic_steps} of them are not under the {self.steps} of"
                " all"
            )
        if self.critic_steps and self.window < self.critic.frames:
            raise RequestError(f"the critic sees {self.critic.frames} frames; windows have {self.window}")
        if not 0 < self.standing_share <= 1:
            raise RequestError(f"the share of standing windows must be over 0 and at most 1: {self.standing_share:g}")


class DensityTrainer(GradientTrainer[LstmGmm]):
    """Draws windows, spoils the inputs, and makes the frames after them likelier."""

    def __init__(
        self,
        config: LstmGmmConfig,
        settings: TrainingSettings,
        corpus: Corpus,
        *,
        labels: Labels | None = None,
        paces: Int[Tensor, " frames"] | None = None,
        init: Mapping[str, Tensor] | None = None,
    ):
        """`labels` of the corpus' clips, the network's own, with those of PACE_LABELS held by none; `paces` of its
        frames, as `follow_paces` finds them, if these are told; `init` holds weights and statistics to begin with."""
        mean, std = compute_feature_statistics(corpus.features)
        super().__init__(lambda: LstmGmm(config, mean=mean, std=std), settings)
        if init is not None:
            self.network.load_state_dict(dict(init))
        self.labels = labels or Labels.none(len(corpus.lengths))
        self.paces = paces
        self._pace_labels = [] if paces is None else [self.labels.names.index(name) for name in PACE_LABELS]
        self.clip_ends = torch.tensor(corpus.lengths).cumsum(0)
        self.windows = FeatureWindows(corpus, settings.window + 1, standing_share=settings.standing_share)
        self._latest = corpus.features[:0], self.labels.held[:0]  # windows of the step under way, and their labels
        self.judge: FreeRunJudge | None = None
        self.average = self.network
        """Moving average of the weights since the critic joined, the weights themselves without one."""
        if settings.critic_steps:
            self.judge = FreeRunJudge(settings.critic, self.windows, seed=settings.seed)
            self.average = copy.deepcopy(self.network).requires_grad_(False)

    @property
    def exported(self) -> LstmGmm:
        """The moving average of the weights."""
        return self.average

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        critic = {} if self.judge is None else {"average": self.average, "critic": self.judge.network}
        return {"model": self.network, **critic}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """One for each of the two that contend."""
        return super().optimisers() | ({} if self.judge is None else {"critic-optimiser": self.judge.optimiser})

    def state(self) -> dict[str, Tensor]:
        """Return everything that a continuation needs, but the step."""
        if self.judge is None or self.judge.history is None:
            return super().state()
        return super().state() | {"history": self.judge.history.windows}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` returned; KeyError or RuntimeError where it is not whole."""
        super().load_state(tensors, step)
        if self.judge is not None and "history" in tensors:
            self.judge.history = HistoryBuffer(tensors["history"].to(self.windows.features.device))

    def train_step(self) -> dict[str, float]:
        """One update, and those of the critic where it has joined; `critic` is its loss, 1.39 where it knows nothing,
        `told` the share of windows that it tells from mocap."""
        if self.judge is not None and self._criticised == 0:
            self._introduce(self.judge)
        parts = super().train_step()
        if self.judge is None:
            return parts
        if self.judge.history is None:
            self.average.load_state_dict(self.network.state_dict())
            return {**parts, **_UNTOLD}
        parts |= self.judge.learn(self.step, self.settings.critic.updates, self.generator)
        keep = min(self.settings.critic.average, self._criticised / (self._criticised + 20))
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - keep)
        return parts

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch, nats a frame."""
        self._latest = self._draw_windows()
        return {"loss": -self._log_prob(*self._latest).mean()}

    def limit_gradients(self) -> None:
        """Clip, and add the gradient of free runs where it is time for it."""
        settings, matching = self.settings, self.settings.matching
        nn.utils.clip_grad_norm_(self.network.parameters(), settings.gradient_clip)
        if self._joined is not None:
            if self._criticised % settings.critic.every == 0:
                self._add_free_run_gradients(*self._latest)
            return
        begin = matching.begin * (self.steps - settings.critic_steps)
        if matching.begin < 1 and self.step >= begin and self.step % matching.every == 0:
            self._add_free_run_gradients(*self._latest)

    def compute_learning_rate(self) -> float:
        """Compute that of the current step."""
        settings = self.settings
        if self._joined is not None:
            return settings.critic.compute_learning_rate(self._criticised, settings.critic_steps)
        steps = self.steps - settings.critic_steps
        warm = min(1.0, (self.step + 1) / 200)
        return warm * settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / steps)))

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Make AdamW with the settings' weight decay."""
        settings, weights = self.settings, self.network.parameters()
        adam = torch.optim.AdamW(weights, lr=settings.learning_rate, weight_decay=settings.weight_decay)
        return {"optimiser": adam}

    def validate(self, corpus: Corpus) -> dict[str, float]:
        """Likelihood and the health of free runs: likelihood does not predict stability."""
        self.average.eval()
        row = {"validation_nats": compute_validation_nats(self.average, corpus)}
        row |= measure_free_runs(self.average, corpus)
        self.average.train()
        return row

    @property
    def _criticised(self) -> int:
        """Steps since the critic joined; below 0 before."""
        return self.step - self.steps + self.settings.critic_steps

    @property
    def _joined(self) -> FreeRunJudge | None:
        """The critic, once it has joined."""
        return self.judge if self._criticised >= 0 else None

    @torch.no_grad()
    def _introduce(self, judge: FreeRunJudge) -> None:
        """Show the critic what the density makes, and let it learn, before the density hears it."""
        settings = self.settings.critic
        self.average.load_state_dict(self.network.state_dict())
        made, count = [], settings.history
        while sum(map(len, made)) < count:
            made.append(self._run_free(*self._draw_windows())[0])
        judge.fill(torch.cat(made)[:count])
        with torch.enable_grad():
            judge.learn(self.step, settings.head_start, self.generator)

    def _run_free(self, windows: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """Free runs after the first windows, told their paces as the network is in this step, and how these go on.

        A pace may change within a window. Gait and style last, and runs have them from the frames they begin with: told
        them as well, a density of walks was no better.
        """
        matching = self.settings.matching
        matching = replace(matching, batch=max(_LEAST_RUNS, matching.batch))
        least = self.settings.critic.frames if self.judge is not None else 0
        paces = torch.zeros_like(told)
        paces[:, self._pace_labels] = told[:, self._pace_labels]
        condition = self._make_condition(told.new_zeros(len(told), 1), paces)
        return run_free(self.network, windows, matching, self.generator, least=least, condition=condition)

    def _add_free_run_gradients(self, windows: Tensor, told: Tensor) -> None:
        """Add the gradient of the free runs' mismatch, and that of what the critic says of them where it has joined,
        each clipped on its own: no loss drowns another."""
        judge, (made, real) = self._joined, self._run_free(windows, told)
        if self.settings.matching.begin < 1:
            moments = moment_loss(made[:, : real.shape[1]], real, self.settings.matching)
            self._add_gradient(moments, retain_graph=judge is not None)
        if judge is not None:
            self._add_gradient(judge.score(made, self.generator))

    def _add_gradient(self, loss: Tensor, *, retain_graph: bool = False) -> None:
        parameters = [p for p in self.network.parameters() if p.requires_grad]
        before = [p.grad for p in parameters]
        for parameter in parameters:
            parameter.grad = None
        loss.backward(retain_graph=retain_graph)
        found = [p.grad for p in parameters]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for g in found if g is not None]))
        share = self.settings.gradient_clip / norm.clamp(min=self.settings.gradient_clip)
        # A free run that left the data's range says nothing.
        share = share if bool(torch.isfinite(norm)) else None
        for parameter, gradient, own in zip(parameters, found, before, strict=True):
            parameter.grad = own
            if gradient is not None and share is not None:
                parameter.grad = share * gradient if own is None else own + share * gradient

    def _draw_windows(self) -> tuple[Float[Tensor, "batch window_and_one size"], Float[Tensor, "batch labels"]]:
        """Windows of clips with the labels that the network is shown."""
        drawn = self.windows.draw(self.settings.batch, self.generator)
        labels = self.labels.held[torch.searchsorted(self.clip_ends, drawn.first, right=True)]
        labels = torch.where(drawn.mirrored[:, None], labels[:, self.labels.mirrored], labels)
        if self.paces is not None:
            # How a window ends: told a pace that is not yet its own, the network changes to it within a window.
            ends = self.paces[drawn.first + self.settings.window]
            labels[:, self._pace_labels] = one_hot(ends, len(PACE_LABELS)).to(labels.dtype)
        return drawn.features, self._tell_some(labels)

    def _tell_some(self, labels: Float[Tensor, "batch labels"]) -> Float[Tensor, "batch labels"]:
        """Mostly show no label or one group only, so that the network works with any subset of labels."""
        if not self.labels.names:
            return labels
        groups = self.labels.groups
        told = torch.rand(len(labels), len(groups), generator=self.generator) < _KEEP_GROUP_PROBABILITY
        told &= torch.rand(len(labels), 1, generator=self.generator) >= self.settings.untold
        return labels * (told.to(labels.dtype) @ groups)

    def _log_prob(self, windows: Tensor, told: Tensor) -> Tensor:
        """Log density of frames 1.. given noisy frames 0..: noise is on the inputs only (section 4.1.3)."""
        model, size = self.network, self.network.layout.continuous
        inputs, level = self._add_noise(model.normalise(windows[:, :-1]), size)
        memory = model.start_after(windows[:, 0])
        condition = self._make_condition(level, told)
        with torch.autocast(windows.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
            mixture, _ = model(inputs, (memory.hidden, memory.cell), condition=condition)
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target, model.whitening)

    def _make_condition(self, level: Float[Tensor, "batch 1"], told: Tensor) -> Float[Tensor, "batch conditions"]:
        """Make what the network is told: the level of its input's noise where it wants to know it, and labels."""
        return torch.cat([level / NOISE_UNIT, told], -1) if self.network.config.knows_noise else told

    def _add_noise(self, inputs: Tensor, size: int) -> tuple[Tensor, Float[Tensor, "batch 1"]]:
        """Inputs with noise and flipped bits, and each window's level of noise."""
        settings, shape = self.settings, inputs.shape
        share = torch.rand(shape[0], 1, 1, generator=self.generator)
        if self.network.config.knows_noise:
            level = settings.input_noise * settings.noise_range * share.square()
        else:
            level = settings.input_noise * torch.exp(share * math.log(settings.noise_range))
        noise = torch.randn(shape[0], shape[1], size, generator=self.generator) * level
        flips = torch.rand(shape[0], shape[1], 2, generator=self.generator) < settings.bit_flips
        bits = torch.where(flips, -inputs[..., size:], inputs[..., size:])
        noisy = torch.cat([inputs[..., :size] + noise, bits], dim=-1)
        return noisy, level[:, 0]


@dataclass(frozen=True)
class DensityRecipe(Recipe[LstmGmmConfig, TrainingSettings, DensityTrainer]):
    """What to train a density on, and how."""

    kind = "lstm-gmm"
    config: LstmGmmConfig = field(default_factory=LstmGmmConfig)
    settings: TrainingSettings = field(default_factory=TrainingSettings)
    starts: int = 64
    """Moments of mocap that the finished prior carries."""
    splices: int = 0
    """Splices of the clips that are tried; those that pass for mocap are trained on as well."""
    stitcher: str = "stitcher"
    """Stitcher of the splices: the bundled one, or the file or run folder of a trained one."""
    labels: str = ""
    """Regular expression whose named groups read labels from a clip's path, to condition the density on."""
    label_pace: bool = False
    """Whether the pace is a label as well: stand, walk or run, by how a window ends. It is where training begins with a
    prior that knows paces."""
    init: str | None = None
    """Prior whose weights and statistics training begins with; the network is then that prior's."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 1, "starts")
        require_at_least(self, 0, "splices")
        if self.label_pace and "(?P<pace>" in self.labels:
            raise RequestError("the group pace is that of --label-pace; call the one of --labels by another name")

    def check(self) -> None:
        """Before anything is read."""
        super().check()
        if self.splices:
            stitcher.load(self.stitcher)  # a wrong name shall not be told after all clips were read

    def gather(self, progress: Progress, warn: Progress) -> Gathered:
        """Read and split the clips, and add their splices to those that are trained on."""
        gathered = super().gather(progress, warn)
        cache, seed = self.out / "cache", self.settings.seed
        train = add_splices(gathered.parts.train, self.splices, self.stitcher, cache, seed=seed)
        if self.splices:
            progress(f"{len(train.names) - len(gathered.parts.train.names)} of {self.splices} splices pass for mocap")
        parts = replace(gathered.parts, train=train)
        return Gathered(gathered.corpus, parts)

    def make_trainer(self, parts: Split) -> DensityTrainer:
        """Make the trainer of a new network for the clips' labels, or of the initial network with its own labels."""
        with use_device("cpu"):  # copies are made one after the other
            seeded = make_generator(self.settings.seed)
            own = self.settings
            copied = add_copies(parts.train.to("cpu"), own.copies, seeded, tempo=own.tempo, strides=own.strides)
            followed = follow_paces(copied) if self.label_pace or self.init is not None else None
        corpus = copied.to(torch.get_default_device().type)
        known = density.read_labels(hide_splices(corpus.names), self.labels)
        followed = None if followed is None else followed.to(corpus.features.device)
        if self.init is None:
            known = known.renamed((*known.names, *PACE_LABELS)) if self.label_pace else known
            config = replace(self.config, labels=known.names)
            return DensityTrainer(config, self.settings, corpus, labels=known, paces=followed)
        before = density.load(self.init).reference
        known, paces = known.renamed(before.config.labels), None
        if {*PACE_LABELS} <= {*known.names}:
            paces = followed
        elif self.label_pace:
            raise RequestError(f"the prior {self.init!r} was not trained with labels of paces; leave --label-pace out")
        return DensityTrainer(before.config, self.settings, corpus, labels=known, paces=paces, init=before.state_dict())

    def find_shape(self, trainer: DensityTrainer) -> LstmGmmConfig:
        """Return the configuration of the network that is trained."""
        return trainer.network.config

    def describe_run(self, trainer: DensityTrainer, corpus: Corpus) -> dict[str, Row]:
        """Describe what must not change between a run's parts."""
        own = {"match": self.chosen, "labels": self.labels, "init": self.init or "", "paces": self.label_pace}
        found = super().describe_run(trainer, corpus)
        return {**found, "data": found["data"] | own | self._describe_splices()}

    def score(self, row: Row) -> float:
        """Return the negative log density of unseen clips, nats a frame."""
        found = row.get("validation_nats")
        return math.nan if found is None else found

    def export(self, trainer: DensityTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """The network with moments to start from, and what the data show to be possible."""
        model, corpus, parts = trainer.average.eval(), gathered.corpus, gathered.parts
        clips, seeded = drop_splices(parts.train), make_generator(self.settings.seed)
        known = density.read_labels(clips.names, self.labels)
        found = select_initial_states(model, clips, count=self.starts, generator=seeded, labels=known.held)
        data = {
            "clips": len(corpus.names),
            "frames": len(corpus.features),
            **corpus.describe_selection(),
            "holds": measure_pace_changes(corpus),
            "match": self.chosen,
            "labels": self.labels,
            **self._describe_splices(),
            "split_seed": self.split_seed,
            "starts": list(found.names),
            "held_out": gathered.held_out(),
        }
        return Export(
            {
                **model.state_dict(),
                "starts.previous": found.state.last_frame,
                "starts.hidden": found.state.hidden,
                "starts.cell": found.state.cell,
                "starts.speed": found.speed,
                "starts.weight": found.weight,
            },
            data,
            measure_quality(model, parts),
            asdict(measure_data_limits(clips)),
        )

    def _describe_splices(self) -> dict[str, str]:
        """How many were tried, and by which stitcher; nothing where there are none."""
        return {"splices": str(self.splices), "stitcher": self.stitcher} if self.splices else {}
