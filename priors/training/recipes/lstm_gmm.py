"""Training of the LSTM-GMM: Wang et al. 2019, section 4.1.3, with departures.

Windows of clips with noise on the inputs; the loss is the negative log density of the next frame (Eq. 8). In the last
quarter of the steps free runs are held to the data's moments, and in the last `critic_steps` a critic of free runs
joins (`priors.training.critics`). Likelihood on held-out clips does not predict stability, so free runs are measured
too.
"""

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import one_hot
from tyro.conf import arg

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.metrics import compute_reference
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.protocols import DataLimits, InitialStates
from priors.checkpoints import require_at_least
from priors.lstm_gmm import density
from priors.lstm_gmm.density import PACE_LABELS, Labels
from priors.lstm_gmm.network import NOISE_UNIT, PAPER, LstmGmm, LstmGmmConfig, LstmState
from priors.training.augment import add_copies
from priors.training.critics import (
    FREE_RUN_MOMENTS,
    HISTORY,
    SEEN_FRAMES,
    CriticTrainer,
    HistoryBuffer,
    moment_loss,
    run_free,
)
from priors.training.data import Corpus, Split, compute_feature_statistics, follow_paces, measure_pace_changes
from priors.training.loop import (
    Count,
    Export,
    GradientTrainer,
    MaybeCount,
    NetworkSettings,
    Number,
    Row,
    make_generator,
    update_average,
    use_device,
)
from priors.training.windows import FeatureWindows

_GRADIENT_CLIP = 5.0
_INPUT_NOISE = 0.05  # standard deviation of the noise on normalised inputs (section 4.1.3)
_NOISE_RANGE = 4.0  # largest noise of a window, as a multiple of that
_BIT_FLIPS = 0.02  # share of input contact bits that are flipped
_UNLABELLED = 0.5  # share of the windows without labels; the others show each group (gait, style) with probability 0.7
_KEEP_GROUP_PROBABILITY = 0.7
_STARTS = 64  # moments of mocap that the finished prior carries
_MATCH_FROM = 0.75  # share of the steps before the critic, after which free runs are held to the data
_MATCH_EVERY, _FREE_RUNS = 4, 32  # steps from one comparison to the next; runs of one
_CRITIC_EVERY = 2  # steps from one free run to the next while the critic judges them
_CRITIC_UPDATES, _CRITIC_HEAD_START = 2, 400  # updates of the critic in a step, and before the first
_CRITIC_RATE = 3e-4  # learning rate of the density while the critic judges
_CRITIC_RISE, _CRITIC_FALL = 20, 0.3  # steps in which it rises, share of the steps in which it falls to nothing
_AVERAGE = 0.995  # share of the past in the running mean of the weights while the critic judges
_SECOND = PRIOR_FPS  # frames
_WARM_UP_FRAMES = 40  # frames of a clip before a start; the memory has settled by then
_SETTLING_FRAMES = 300


@dataclass(frozen=True, kw_only=True)
class DensitySettings(NetworkSettings):
    """Train the density that follow, generate, steer and others use as their prior."""

    kind = "lstm-gmm"
    used_by = "use it with --prior"
    single_thread = False
    ours, papers = LstmGmmConfig(), PAPER
    shape_options = ("width", "paper")

    steps: Count = 20_000
    """Steps in all."""
    batch: Count = 128
    """Windows a step."""
    window: Count = 50
    """Frames a window."""
    width: MaybeCount = None
    """Units of every hidden layer."""
    paper: bool = False
    """The network of Wang et al. 2019; other options still hold."""
    labels: Annotated[str, arg(metavar="REGEX")] = ""
    """Named groups read labels from the clips' paths, as in '_(?P<gait>walk|run)_(?P<style>[a-z]+)_', for --style."""
    label_pace: bool = False
    """Make the pace a label as well: stand, walk or run, by how a window of training ends. Random motion is then given
    one pace after another, as often as the clips change theirs."""
    copies: Count = 0
    """Copies of each clip at other tempos and with other strides that training sees beside it: for a few minutes of
    motion (docs/guides/data.md)."""
    critic_steps: Count = 0
    """Last steps in which a critic joins that separates a second of a free run from captured motion, and the density is
    trained to pass as well; what is kept is then the running mean of the weights."""
    standing_share: Number = 1.0
    """How often windows of standing characters are drawn, as a share of others: below 1 for motion that mostly stands,
    whose density is hard to steer into a walk otherwise."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 0, "copies", "critic_steps")
        if not 0 < self.standing_share <= 1:
            raise RequestError(f"--standing-share is over 0 and at most 1, got {self.standing_share:g}")
        if self.critic_steps >= self.steps:
            raise RequestError(
                f"a critic joins the last steps of a run: {self.critic_steps} are not under {self.steps}"
            )
        if self.critic_steps and self.window < SEEN_FRAMES:
            raise RequestError(f"the critic sees {SEEN_FRAMES} frames; windows have {self.window}")
        if self.label_pace and "(?P<pace>" in self.labels:
            raise RequestError("the group pace is that of --label-pace; call the one of --labels by another name")

    def make_trainer(self, parts: Split) -> "DensityTrainer":
        """Make the trainer of a network for the clips' labels, or of the initial network with its own labels."""
        with use_device("cpu"):  # copies are generated one after the other
            seeded, train = make_generator(self.seed), parts.train.to("cpu")
            copied = add_copies(train, self.copies, seeded)
        corpus = copied.to(torch.get_default_device().type)
        known, config = density.read_labels(corpus.names, self.labels), self.find_config()
        if self.init is None:
            known = known.renamed((*known.names, *PACE_LABELS)) if self.label_pace else known
            config = replace(config, labels=known.names)
        known = known.renamed(config.labels)
        with_paces = {*PACE_LABELS} <= {*config.labels}
        if self.label_pace and not with_paces:
            raise RequestError(f"the prior {self.init!r} was not trained with labels of paces; leave --label-pace out")
        paces = follow_paces(copied).to(corpus.features.device) if with_paces else None
        return DensityTrainer(self, corpus, config, known, paces)


class DensityTrainer(GradientTrainer[LstmGmm]):
    """Draws windows, adds noise to the inputs, and makes the frames after them likelier."""

    def __init__(
        self,
        settings: DensitySettings,
        corpus: Corpus,
        config: LstmGmmConfig,
        labels: Labels | None = None,
        paces: Int[Tensor, " frames"] | None = None,
    ):
        """`labels` of the corpus' clips, the network's own, with those of PACE_LABELS held by none; `paces` of its
        frames, as `follow_paces` finds them, if these are labels."""
        mean, std = compute_feature_statistics(corpus.features)
        super().__init__(settings, lambda: LstmGmm(config, mean=mean, std=std))
        self.config, self.labels, self.paces = config, labels or Labels.none(len(corpus.lengths)), paces
        self._pace_labels = [] if paces is None else [self.labels.names.index(name) for name in PACE_LABELS]
        self.clip_ends = torch.tensor(corpus.lengths).cumsum(0)
        self.windows = FeatureWindows(corpus, settings.window + 1, standing_share=settings.standing_share)
        self._latest = corpus.features[:0], self.labels.held[:0]  # windows of the step under way, and their labels
        self.begin()
        self.critic_trainer: CriticTrainer | None = None
        self.average = self.network
        """Moving average of the weights since the critic joined."""
        if settings.critic_steps:
            self.critic_trainer = CriticTrainer(self.windows, seed=settings.seed)
            self.average = copy.deepcopy(self.network).requires_grad_(False)

    @property
    def exported(self) -> LstmGmm:
        joined = self.critic_trainer is not None and self.critic_trainer.history is not None
        return self.average if joined else self.network

    def networks(self) -> dict[str, nn.Module]:
        critic = {} if self.critic_trainer is None else {"average": self.average, "critic": self.critic_trainer.network}
        return {"model": self.network, **critic}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return super().optimisers() | (
            {} if self.critic_trainer is None else {"critic-optimiser": self.critic_trainer.optimiser}
        )

    def state(self) -> dict[str, Tensor]:
        history = self.critic_trainer and self.critic_trainer.history
        return super().state() | ({"history": history.windows} if history else {})

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        super().load_state(tensors, step)
        if self.critic_trainer is not None and "history" in tensors:
            self.critic_trainer.history = HistoryBuffer(tensors["history"].to(self.windows.features.device))

    def train_step(self) -> dict[str, float]:
        """One update, and those of the critic where it has joined: `critic` is its loss, 1.39 where it has learnt
        nothing, `accuracy` the share of windows that it classifies correctly."""
        if self.critic_trainer is not None and self._criticised == 0:
            self._introduce(self.critic_trainer)
        parts = super().train_step()
        if self.critic_trainer is None or self.critic_trainer.history is None:
            return parts
        parts |= self.critic_trainer.learn(self.step, _CRITIC_UPDATES, self.generator)
        update_average(self.average, self.network, min(_AVERAGE, self._criticised / (self._criticised + 20)))
        return parts

    def losses(self) -> dict[str, Tensor]:
        self._latest = self.draw_windows()
        return {"loss": -self._log_prob(*self._latest).mean()}

    def limit_gradients(self) -> None:
        """Clip, and add the gradient of free runs where it is time for it."""
        nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_CLIP)
        joined = self.critic_trainer is not None and self._criticised >= 0
        begun = self.step >= _MATCH_FROM * (self.steps - self.settings.critic_steps)
        if self._criticised % _CRITIC_EVERY == 0 if joined else begun and self.step % _MATCH_EVERY == 0:
            self._add_free_run_gradients(self.critic_trainer if joined else None)

    def compute_learning_rate(self) -> float:
        settings = self.settings
        if self._criticised >= 0:
            left = (settings.critic_steps - self._criticised) / max(1.0, _CRITIC_FALL * settings.critic_steps)
            return _CRITIC_RATE * min(1.0, (self._criticised + 1) / _CRITIC_RISE) * min(1.0, left)
        steps = self.steps - settings.critic_steps
        warm = min(1.0, (self.step + 1) / 200)
        return warm * settings.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, self.step / steps)))

    def validate(self, corpus: Corpus) -> dict[str, float]:
        """Measure the likelihood and the health of free runs."""
        nats = compute_validation_nats(self.exported, corpus)
        return {"validation_nats": nats, **measure_free_runs(self.exported, corpus)}

    def score(self, row: Row) -> float:
        """Return the negative log density of unseen clips, nats a frame."""
        return row.get("validation_nats") or math.nan

    def export(self, parts: Split) -> Export:
        """The network with moments to start from, and what the data show to be possible."""
        model, settings = self.exported, self.settings
        known = density.read_labels(parts.train.names, settings.labels)
        found = select_initial_states(
            model, parts.train, count=_STARTS, generator=make_generator(settings.seed), labels=known.held
        )
        starts = {
            "starts.previous": found.state.last_frame,
            "starts.hidden": found.state.hidden,
            "starts.cell": found.state.cell,
            "starts.speed": found.speed,
            "starts.weight": found.weight,
        }
        data = {"holds": measure_pace_changes(parts.whole), "labels": settings.labels, "starts": list(found.names)}
        held = [decode(clip, GroundPose.origin()) for part in (parts.validation, parts.test) for clip in part.clips()]
        mocap = {name: spread._asdict() for name, spread in compute_reference(held).items()}
        quality = {
            "test_nats_per_frame": compute_validation_nats(model, parts.test),
            "windows": compute_window_nats(model, (parts.validation, parts.test)),
            "mocap": {name: row for name, row in mocap.items() if not math.isnan(row["mean"])},
            "data": summarise_states(parts.train.features),
        }
        return Export({**model.state_dict(), **starts}, data, quality, asdict(measure_data_limits(parts.train)))

    @property
    def _criticised(self) -> int:
        """Steps since the critic joined; below 0 before."""
        return self.step - self.steps + self.settings.critic_steps

    @torch.no_grad()
    def _introduce(self, critic_trainer: CriticTrainer) -> None:
        """Show free runs to the critic, and let it learn before the density is trained by it."""
        self.average.load_state_dict(self.network.state_dict())
        runs: list[Tensor] = []
        while sum(map(len, runs)) < HISTORY:
            runs.append(self._run_free(*self.draw_windows())[0])
        critic_trainer.fill(torch.cat(runs)[:HISTORY])
        with torch.enable_grad():
            critic_trainer.learn(self.step, _CRITIC_HEAD_START, self.generator)

    def _run_free(self, windows: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
        """Free runs after the first windows, given their paces as the network is in this step, and how these go on.

        A pace may change within a window. Gait and style last, and runs have them from the frames they begin with:
        given them as well, a density of walks was no better.
        """
        windows, shown = windows[:_FREE_RUNS], shown[:_FREE_RUNS]
        paces = torch.zeros_like(shown)
        paces[:, self._pace_labels] = shown[:, self._pace_labels]
        condition = self._make_condition(shown.new_zeros(len(shown), 1), paces)
        least = SEEN_FRAMES if self.critic_trainer is not None else 0
        return run_free(self.network, windows, self.generator, least=least, condition=condition)

    def _add_free_run_gradients(self, critic_trainer: CriticTrainer | None) -> None:
        """Add the gradient of the free runs' mismatch, and that of the critic's loss where it has joined, each clipped
        on its own: no loss drowns another."""
        generated, real = self._run_free(*self._latest)
        moments = moment_loss(generated[:, : real.shape[1]], real, FREE_RUN_MOMENTS)
        self._add_gradient(moments, retain_graph=critic_trainer is not None)
        if critic_trainer is not None:
            self._add_gradient(critic_trainer.score(generated, self.generator))

    def _add_gradient(self, loss: Tensor, *, retain_graph: bool = False) -> None:
        parameters = [p for p in self.network.parameters() if p.requires_grad]
        found = torch.autograd.grad(loss, parameters, retain_graph=retain_graph, allow_unused=True)
        used = [(p, g.contiguous()) for p, g in zip(parameters, found, strict=True) if g is not None]
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for _, g in used]))
        if bool(torch.isfinite(norm)):  # a free run that left the data's range carries no information
            share = _GRADIENT_CLIP / norm.clamp(min=_GRADIENT_CLIP)
            for parameter, gradient in used:
                parameter.grad = share * gradient if parameter.grad is None else parameter.grad + share * gradient

    def draw_windows(self) -> tuple[Float[Tensor, "batch window_and_one size"], Float[Tensor, "batch labels"]]:
        """Windows of clips with the labels that the network is shown."""
        drawn = self.windows.draw(self.settings.batch, self.generator)
        labels = self.labels.held[torch.searchsorted(self.clip_ends, drawn.first, right=True)]
        labels = torch.where(drawn.mirrored[:, None], labels[:, self.labels.mirrored], labels)
        if self.paces is not None:
            # How a window ends: given a pace that is not yet its own, the network changes to it within a window.
            ends = self.paces[drawn.first + self.settings.window]
            labels[:, self._pace_labels] = one_hot(ends, len(PACE_LABELS)).to(labels.dtype)
        if not self.labels.names:
            return drawn.features, labels
        # Mostly no label or one group only, so that the network works with any subset of labels.
        groups = self.labels.groups
        shown = torch.rand(len(labels), len(groups), generator=self.generator) < _KEEP_GROUP_PROBABILITY
        shown &= torch.rand(len(labels), 1, generator=self.generator) >= _UNLABELLED
        return drawn.features, labels * (shown.to(labels.dtype) @ groups)

    def _log_prob(self, windows: Tensor, shown: Tensor) -> Tensor:
        """Log density of frames 1.. given noisy frames 0..: noise is on the inputs only (section 4.1.3)."""
        model, size = self.network, LAYOUT.continuous
        inputs, level = self._add_noise(model.normalise(windows[:, :-1]), size)
        memory = model.start_after(windows[:, 0])
        condition = self._make_condition(level, shown)
        with torch.autocast(windows.device.type, torch.bfloat16, enabled=self.settings.bfloat16):
            mixture, _ = model(inputs, (memory.hidden, memory.cell), condition=condition)
        target = torch.cat([model.normalise(windows[:, 1:])[..., :size], windows[:, 1:, size:]], dim=-1)
        return mixture.log_prob(target, model.inverse_cholesky)

    def _make_condition(self, level: Float[Tensor, "batch 1"], shown: Tensor) -> Float[Tensor, "batch conditions"]:
        """Return the network's condition: the level of its input's noise where it takes it, and labels."""
        return torch.cat([level / NOISE_UNIT, shown], -1) if self.network.config.knows_noise else shown

    def _add_noise(self, inputs: Tensor, size: int) -> tuple[Tensor, Float[Tensor, "batch 1"]]:
        """Inputs with noise and flipped bits, and each window's level of noise: log-uniform, or, where the network is
        given it, all levels down to none, low ones more often."""
        shape = inputs.shape
        share = torch.rand(shape[0], 1, 1, generator=self.generator)
        if self.network.config.knows_noise:
            level = _INPUT_NOISE * _NOISE_RANGE * share.square()
        else:
            level = _INPUT_NOISE * torch.exp(share * math.log(_NOISE_RANGE))
        noise = torch.randn(shape[0], shape[1], size, generator=self.generator) * level
        flips = torch.rand(shape[0], shape[1], 2, generator=self.generator) < _BIT_FLIPS
        bits = torch.where(flips, -inputs[..., size:], inputs[..., size:])
        noisy = torch.cat([inputs[..., :size] + noise, bits], dim=-1)
        return noisy, level[:, 0]


def summarise_states(features: Float[Tensor, "frames size"]) -> dict[str, float]:
    """Summarise mean speed (m/s), mean root height (m) and mean standard deviation of the joint rotations (rad)."""
    return {
        "speed": float(ground_speed(features).mean()),
        "height": float(LAYOUT.pick(features, "root_height").mean()),
        "pose": float(LAYOUT.pick(features, "joint_rotations").std(0).mean()),
    }


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
    strata = torch.zeros(len(features), dtype=torch.long)
    if labels is not None and labels.shape[1]:
        strata = torch.unique(labels, dim=0, return_inverse=True)[1]
    frames = torch.tensor(corpus.lengths, dtype=torch.float32)
    frames_of, of_starts = torch.zeros(int(strata.max()) + 1).index_add_(0, strata, frames), strata[shuffled]
    clips_of = torch.bincount(of_starts, minlength=len(frames_of))
    picked = []
    for stratum, share in enumerate(_share_out(frames_of.tolist(), clips_of, count)):
        members = torch.nonzero(of_starts == stratum)[:, 0]
        picked += members[_select_by_speed(speeds[members], share)].tolist() if share else []
    before = [features[shuffled[k]][: ends[k]] for k in picked]
    with torch.no_grad():
        states = [model.advance(model.start_after(clip[:1]), clip[1:].unsqueeze(0)) for clip in before]
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
    turn_rate = float(turns.quantile(0.995)) if len(turns) else 0.0  # the data may hold no walk
    return DataLimits(float(speeds.quantile(0.01)), float(speeds.quantile(0.99)), turn_rate)


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


def measure_free_runs(model: LstmGmm, corpus: Corpus, *, runs: int = 8, frames: int = 1500) -> dict[str, float]:
    """Speed, height and pose variation of free runs, each as a ratio to the corpus, and the slowest run's last speed.

    Runs begin after the first two seconds of clips; their first ten seconds are not counted.
    """
    clips = [clip for clip in corpus.clips() if len(clip) > 60]
    clips = [clips[i * len(clips) // runs % len(clips)] for i in range(runs)]
    state = model.start_after(torch.stack([clip[0] for clip in clips]).to(model.mean.device))
    state = model.advance(state, torch.stack([clip[1:60] for clip in clips]).to(model.mean.device))
    features, _ = model.sample(state, frames, make_generator(0))
    settled = features[:, min(_SETTLING_FRAMES, frames // 2) :].cpu()
    own, wanted = summarise_states(settled.flatten(0, 1)), summarise_states(corpus.features)
    result = {f"free_run_{name}_ratio": own[name] / wanted[name] for name in own}
    result["free_run_slowest_m_s"] = float(ground_speed(settled[:, -150:]).mean(-1).min())
    result["free_run_finite"] = float(torch.isfinite(features).all())
    return result


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
    98 % of them reach. A density is trusted by it (see mapctl.problem.density_selection); clips begin with an
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
