"""The stitcher: short gaps between whole poses, in as many variations as are drawn (Ren et al. 2024, sections 3.2, 3.3,
4.1).

Two generators, one from each pose, step towards each other until they overlap; both sides are computed in one call, on
tensors with a leading axis of two, forward first, and share no weights. Each side encodes its current frame, the other
side's latest frame, and where and when that is. An LSTM and heads give the distribution of the latent now and on
arrival, and a decoder LSTM with experts gated by the phase gives the next frame. The sides are then joined: the overlap
is blended, and what they disagree on in position is spread over the whole transition, where the paper's blend of the
overlap alone would slide both feet.

Departures from what is printed:

- The paper's encoder sees the two frames and not what comes between. Here a posterior, in training alone, sees the true
  in-between, and the paper's encoder is the prior that it is held to.
- Most of the latent belongs to the whole transition and is the same for both sides, so that they agree on which foot
  goes first; the rest, a frame's, changes slowly.
- The output is added to a step between the one that led to the frame, where that is known, and the one that would lead
  to the target at an even pace. Untrained, the network interpolates bare poses.
- The decoder is given the offset and the encoder's output too; the experts are given the shared latent.
- Both sides step at once, and arrival is measured to the target in force.
- Widths give 2 million weights a generator, not 13.4. Features of `mapctl.features` (68), of frames and of changes,
  replace root positions and quaternions.
"""

import math
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import elu

from mapctl import contacts, rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, mirror_features, reversed_features
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.protocols import Inbetweener
from mapctl.runtime.stepwise import StepwiseWork
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size, Sizes

SIDES = 2
"""Forward and backward."""


class SidedLinear(nn.Module):
    """An affine layer a side."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(SIDES, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(SIDES, 1, outputs))
        self._rounded: Tensor | None = None

    def forward(self, x: Float[Tensor, "2 batch inputs"]) -> Float[Tensor, "2 batch outputs"]:
        """Return the outputs of each side."""
        if self._rounded is None:
            return torch.baddbmm(self.bias, x, self.weight)
        return self.bias + torch.bmm(x.bfloat16(), self._rounded).float()


@contextmanager
def multiply_in_bfloat16(*networks: nn.Module, wanted: bool = True) -> Iterator[None]:
    """Let all sided layers of these networks multiply in bfloat16 meanwhile, if it is wanted: weights are rounded once
    for all frames that are generated."""
    layers = [layer for network in networks for layer in network.modules() if isinstance(layer, SidedLinear)]
    try:
        for layer in layers if wanted else ():
            layer._rounded = layer.weight.bfloat16()
        yield
    finally:
        for layer in layers:
            layer._rounded = None


class SidedLayers(nn.Module):
    """Affine layers with ELU between them, of one or of several experts: blending what these give before each
    nonlinearity is blending their weights (Zhang et al. 2018)."""

    def __init__(self, *widths: int, experts: int = 1):
        super().__init__()
        self.experts = experts
        self.layers = nn.ModuleList(SidedLinear(one, experts * other) for one, other in pairwise(widths))

    def forward(
        self, x: Float[Tensor, "2 batch inputs"], share: Float[Tensor, "2 batch experts"] | None = None
    ) -> Float[Tensor, "2 batch outputs"]:
        """Return the outputs of each side, for the experts' shares."""
        for number, layer in enumerate(self.layers):
            x = layer(elu(x) if number else x)
            if share is not None:
                x = (share[..., None] * x.unflatten(-1, (self.experts, -1))).sum(dim=-2)
        return x

    def shrink_last(self, share: float) -> None:
        """Shrink the initial output of the last layer."""
        with torch.no_grad():
            list(self.layers.parameters())[-2].mul_(share)


class SidedLstm(nn.Module):
    """A cell of an LSTM a side (Hochreiter and Schmidhuber 1997), its forget gate open at first."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.width, self.gates = width, SidedLinear(inputs + width, 4 * width)
        with torch.no_grad():
            self.gates.bias[..., width : 2 * width] = 1.0

    def forward(
        self, x: Float[Tensor, "2 batch inputs"], state: tuple[Tensor, Tensor]
    ) -> tuple[Float[Tensor, "2 batch width"], Float[Tensor, "2 batch width"]]:
        """Return the output and the cell after this frame."""
        output, cell = state
        enter, forget, leave, new = self.gates(torch.cat([x, output], dim=-1)).chunk(4, dim=-1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(enter) * torch.tanh(new)
        return torch.sigmoid(leave) * torch.tanh(cell), cell


PHASES = 4
"""Numbers of the two toes' phases."""
POSE = slice(LAYOUT.slices["root_height"].start, LAYOUT.continuous)
"""Columns of the pose among features; before it are the step and the turn, after it the contacts."""
PACE = slice(0, POSE.start)
"""Columns of the step over the ground and of the turn."""
SEEN_FUTURE = 5
"""True frames ahead that the posterior sees of a frame."""
_POSE_SIZE = POSE.stop - POSE.start
_STATE, _OFFSET = LAYOUT.size + _POSE_SIZE + 1, _POSE_SIZE + 3
_CLAMP = 5.0  # spreads of a pose's change from frame to frame, beyond which no change goes
_WAVE_BASE = 10_000.0  # of the sinusoids of time to arrival, as in the paper
_LEAST_LOG_SIGMA, _MOST_LOG_SIGMA = -5.0, 1.0


@dataclass(frozen=True)
class StitcherConfig(NetworkConfig):
    """Shape of one side's networks; the other's is the same."""

    FIXED: ClassVar = {"without": ["d"], "printed": False}

    embedding: Sizes = (192, 192, 96)
    """Layers of the encoders of state, offset and target; the last is even."""
    encoder: Size = 192
    """Width of the encoder LSTM."""
    head: Size = 128
    """Width of the layer before the distributions."""
    shared: Size = 16
    """Numbers of the latent that both sides share over a transition."""
    own: Size = 4
    """Numbers of the latent of each frame."""
    decoder: Size = 256
    """Width of the decoder LSTM."""
    experts: Size = 4
    """Experts that the phase gates."""
    expert: Sizes = (224, 160)
    """Hidden layers of an expert."""
    gate: Sizes = (64, 32)
    """Hidden layers of the gate."""
    phase: Size = 128
    """Width of the two hidden layers of the phase's networks."""
    longest: Size = 61
    """Frames from one pose to the other in the longest transition."""

    def __post_init__(self):
        if self.embedding[-1] % 2 or self.longest < 2:
            raise RequestError("a stitcher's embedding is even, and its longest transition of 2 frames at least")


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of both sides in physical units, each in its side's own sense of time."""

    features: Float[Tensor, "2 batch size"]  # features
    change: Float[Tensor, "2 batch pose"]  # change of the pose in the step that led there
    paced: Float[Tensor, "2 batch"]  # 1 where change, step, turn and contacts are known

    def exchange(self) -> "Frame":
        """Return for each side the other's frame in its own sense of time: what led there leads on from there."""
        features = self.features.flip(0)
        step, turn = _pick_pace(features)
        back = -rotations.rotate_ground(step, -turn)
        features = torch.cat([back, -turn[..., None], features[..., POSE.start :]], dim=-1)
        return Frame(features, -self.change.flip(0), self.paced.flip(0))


@dataclass(frozen=True, eq=False)
class Situation:
    """Input of both sides for one frame."""

    now: Frame  # current frames
    target: Frame  # frames to which they go
    position: Float[Tensor, "2 batch 2"]  # of the target, seen from the current frame, metres
    turn: Float[Tensor, "2 batch"]  # difference of the headings, radians in -pi to pi
    left: Float[Tensor, "2 batch"]  # frames to the target

    @staticmethod
    def of(now: Frame, at: GroundPose, target: Frame, target_at: GroundPose, left: float) -> "Situation":
        """See from each side the frame that is given for the other."""
        away = target_at.position_xz.flip(0) - at.position_xz
        return Situation(
            now,
            target.exchange(),
            rotations.rotate_ground(away, -at.heading),
            rotations.wrap_angle(target_at.heading.flip(0) - at.heading),
            torch.full_like(now.paced, left),
        )

    def on_arrival(self) -> "Situation":
        """Return the input if the target were reached."""
        nil = torch.zeros_like(self.left)
        return Situation(self.target, self.target, torch.zeros_like(self.position), nil, nil)


@dataclass(frozen=True, eq=False)
class Memory:
    """Memory of the sides from frame to frame."""

    encoder: tuple[Tensor, Tensor]
    decoder: tuple[Tensor, Tensor]
    phase: Float[Tensor, "2 batch 4"]  # amplitude times cosine and sine of both toes' phases

    def keep(self, before: "Memory", active: Float[Tensor, "2 batch"]) -> "Memory":
        """Return this memory where a side is active, and the one before elsewhere."""
        kept = active[..., None]
        ours, theirs = ((*each.encoder, *each.decoder, each.phase) for each in (self, before))
        parts = [kept * now + (1 - kept) * then for now, then in zip(ours, theirs, strict=True)]
        return Memory((parts[0], parts[1]), (parts[2], parts[3]), parts[4])


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A normal distribution with independent numbers."""

    mean: Float[Tensor, "*batch latent"]
    log_sigma: Float[Tensor, "*batch latent"]

    @staticmethod
    def of(raw: Float[Tensor, "*batch twice"]) -> "Gaussian":
        """Read one from a head."""
        mean, log_sigma = raw.chunk(2, dim=-1)
        return Gaussian(mean, log_sigma.clamp(_LEAST_LOG_SIGMA, _MOST_LOG_SIGMA))

    def row(self, part: slice) -> "Gaussian":
        """Return some rows."""
        return Gaussian(self.mean[part], self.log_sigma[part])

    def draw(self, noise: Float[Tensor, "*batch latent"]) -> Float[Tensor, "*batch latent"]:
        """Return what standard normal noise becomes."""
        return self.mean + self.log_sigma.exp() * noise

    def blend(self, other: "Gaussian", share: Float[Tensor, "*batch"]) -> "Gaussian":
        """Blend means and standard deviations: Ren et al. 2024, Eq. 1, which blends densities."""
        share = share[..., None]
        sigma = torch.lerp(self.log_sigma.exp(), other.log_sigma.exp(), share)
        return Gaussian(torch.lerp(self.mean, other.mean, share), sigma.log())

    def detach(self) -> "Gaussian":
        """Return the same, through which nothing learns."""
        return Gaussian(self.mean.detach(), self.log_sigma.detach())

    def diverge(self, prior: "Gaussian") -> Float[Tensor, "*batch latent"]:
        """Compute the Kullback-Leibler divergence from a prior, nats a dimension."""
        ratio = 2 * (self.log_sigma - prior.log_sigma)
        away = ((self.mean - prior.mean) * (-prior.log_sigma).exp()).square()
        return 0.5 * (ratio.exp() + away - 1 - ratio)


class StitcherNetwork(nn.Module):
    """Both generators; untrained they interpolate from one pose to the other."""

    mean: Tensor
    std: Tensor
    change: Tensor
    temperature: Tensor
    waves: Tensor

    def __init__(self, config: StitcherConfig):
        super().__init__()
        self.config = config
        last, seen = config.embedding[-1], 3 * config.embedding[-1]
        given = seen + config.encoder
        self.state = SidedLayers(_STATE, *config.embedding)
        self.offset = SidedLayers(_OFFSET, *config.embedding)
        self.target = SidedLayers(_STATE, *config.embedding)
        self.encoder = SidedLstm(seen, config.encoder)
        self.now = SidedLayers(config.encoder, config.head, 2 * config.own)
        self.arrived = SidedLayers(config.encoder, config.head, 2 * config.own)
        self.decoder = SidedLstm(given + config.shared + config.own, config.decoder)
        self.experts = SidedLayers(config.decoder + config.shared, *config.expert, LAYOUT.size, experts=config.experts)
        self.carry = nn.Parameter(torch.zeros(2, SIDES, 1, POSE.stop))
        self.gate = SidedLayers(PHASES, *config.gate, config.experts)
        self.first_phase = SidedLayers(seen, config.phase, PHASES)
        self.next_phase = SidedLayers(LAYOUT.size + PHASES, config.phase, config.phase, PHASES)
        self.prior = nn.Sequential(
            nn.Linear(SIDES * seen, config.head), nn.ELU(), nn.Linear(config.head, 2 * config.shared)
        )
        for layers in (self.experts, self.next_phase, self.now, self.arrived):
            layers.shrink_last(0.1)
        with torch.no_grad():  # few numbers among many: at the usual size they would be learnt to be ignored
            self.decoder.gates.weight[:, given : given + config.shared + config.own].mul_(4)
        self.register_buffer("mean", torch.zeros(LAYOUT.size))
        self.register_buffer("std", torch.ones(LAYOUT.size))
        self.register_buffer("change", torch.ones(LAYOUT.size))
        self.register_buffer("temperature", torch.ones(()))  # standard deviation of the noise of draws
        waves = _WAVE_BASE ** (-torch.arange(0, last, 2, device="cpu") / last)
        self.register_buffer("waves", waves, persistent=False)

    def embed(self, now: Situation) -> Float[Tensor, "2 batch seen"]:
        """Embed state, offset and target, each with the time to arrival (Eq. 11 and 12)."""
        time = self._wave(now.left)
        pose = (now.target.features - now.now.features)[..., POSE] / self.std[POSE]
        offset = torch.cat([now.position, now.turn[..., None], pose], dim=-1)
        parts = (self.state(self._normalise(now.now)), self.offset(offset), self.target(self._normalise(now.target)))
        return torch.cat([part + time for part in parts], dim=-1)

    def begin(self, seen: Float[Tensor, "2 batch seen"]) -> Memory:
        """Return the memory before the first frame."""
        shape = seen.shape[:2]
        encoder, decoder = (
            (seen.new_zeros(*shape, width), seen.new_zeros(*shape, width))
            for width in (self.config.encoder, self.config.decoder)
        )
        return Memory(encoder, decoder, self.first_phase(seen))

    def infer_shared(self, seen: Float[Tensor, "2 batch seen"]) -> Gaussian:
        """Tell the distribution of what both sides share, from what they see at first."""
        return Gaussian.of(self.prior(seen.transpose(0, 1).flatten(1)))

    def encode(
        self, seen: Float[Tensor, "2 batch seen"], now: Situation, memory: Memory, arrived: Float[Tensor, "2 batch"]
    ) -> tuple[Float[Tensor, "2 batch width"], tuple[Tensor, Tensor], Gaussian]:
        """Encode a frame at which a side has `arrived` by some share; also returns the LSTM's memory and the prior's
        distribution of the frame's latent: that of now, and by this share that on arrival (Eq. 1)."""
        output, cell = self.encoder(seen, memory.encoder)
        there = self.embed(now.on_arrival())
        arrival = Gaussian.of(self.arrived(self.encoder(there, memory.encoder)[0]))
        return output, (output, cell), Gaussian.of(self.now(output)).blend(arrival, arrived)

    def decode(
        self,
        seen: Float[Tensor, "2 batch seen"],
        encoded: Float[Tensor, "2 batch width"],
        latent: Float[Tensor, "2 batch latent"],
        now: Situation,
        memory: Memory,
        encoder: tuple[Tensor, Tensor],
    ) -> tuple[Float[Tensor, "2 batch size"], Float[Tensor, "2 batch 2"], Memory]:
        """Make the next frame's features, contacts as probabilities, their logits, and the memory after it."""
        output, cell = self.decoder(torch.cat([seen, encoded, latent], dim=-1), memory.decoder)
        share = torch.softmax(self.gate(memory.phase.detach()), dim=-1)
        generated = self.experts(torch.cat([output, latent[..., : self.config.shared]], dim=-1), share)
        pace, change = self._lean(now)
        pace = pace + generated[..., PACE] * self.std[PACE]
        pose = now.now.features[..., POSE] + change + generated[..., POSE].clamp(-_CLAMP, _CLAMP) * self.change[POSE]
        logits = generated[..., POSE.stop :]
        features = torch.cat([pace, pose, torch.sigmoid(logits)], dim=-1)
        step = self.next_phase(torch.cat([(features.detach() - self.mean) / self.std, memory.phase], dim=-1))
        return features, logits, Memory(encoder, (output, cell), memory.phase + step)

    def _lean(self, now: Situation) -> tuple[Float[Tensor, "2 batch pace"], Float[Tensor, "2 batch pose"]]:
        """Return the step, turn and change of pose to which the output is added: between those that led to the frame
        and those that lead to the target at an even pace."""
        left = now.left.clamp_min(1)[..., None]
        even = 1 / left
        # None of a bare pose's, and none in the last step to the target.
        share = torch.sigmoid(4 * (self.carry[0] + self.carry[1] * left / self.config.longest))
        kept = now.now.paced[..., None] * share * (1 - 1 / left)
        pace = torch.cat([now.position, now.turn[..., None]], dim=-1) * even
        change = (now.target.features - now.now.features)[..., POSE] * even
        return (
            torch.lerp(pace, now.now.features[..., PACE], kept[..., PACE]),
            torch.lerp(change, now.now.change, kept[..., POSE]),
        )

    def _normalise(self, frame: Frame) -> Float[Tensor, "2 batch state"]:
        """Return features and change in units of spread, unknown parts of a bare pose at zero, and their flag."""
        known = frame.paced[..., None]
        scaled = (frame.features - self.mean) / self.std
        moved = (frame.change / self.change[POSE]).clamp(-_CLAMP, _CLAMP)
        return torch.cat(
            [scaled[..., PACE] * known, scaled[..., POSE], scaled[..., POSE.stop :] * known, moved * known, known],
            dim=-1,
        )

    def _wave(self, left: Float[Tensor, "2 batch"]) -> Float[Tensor, "2 batch embedding"]:
        """Return sinusoids of the frames to arrival, no more than the longest transition."""
        angle = left.clamp_max(float(self.config.longest))[..., None] * self.waves
        return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(-2)


_WIDTH = 128
_MOMENTS = 8  # at which a side is looked at, its ends among them
_LEAST_SIGMA = 0.3  # of what is shared: each number carries at most a nat and a quarter


class PosteriorNetwork(nn.Module):
    """Distributions of what both sides share, and of each frame's latent."""

    def __init__(self, config: StitcherConfig):
        super().__init__()
        self.frame = nn.Sequential(nn.Linear(LAYOUT.size, _WIDTH), nn.ELU(), nn.Linear(_WIDTH, _WIDTH), nn.ELU())
        self.whole = nn.Sequential(
            nn.Linear(SIDES * (_MOMENTS + 1) * _WIDTH, 2 * _WIDTH), nn.ELU(), nn.Linear(2 * _WIDTH, 2 * config.shared)
        )
        self.next = SidedLayers(SEEN_FUTURE * LAYOUT.size + config.encoder, 2 * _WIDTH, 2 * config.own)

    def infer_shared(self, missed: Float[Tensor, "2 batch generated size"]) -> Gaussian:
        """Tell it from what the calm answer of both sides misses of the truth, in units of the features' spread.

        So it holds what the two ends do not. Over the batch each number's mean has unit variance, so that what is given
        cannot fade away (Zhu et al. 2020, "A batch normalized inference network keeps the KL vanishing away").
        """
        frames = self.frame(missed)
        at = torch.linspace(0, frames.shape[2] - 1, _MOMENTS).round().long()
        parts = torch.cat([frames.mean(dim=2, keepdim=True), frames[:, :, at]], dim=2)
        mean, raw = self.whole(parts.transpose(0, 1).flatten(1)).chunk(2, dim=-1)
        mean = (mean - mean.mean(dim=0)) / (mean.var(dim=0, correction=0) + 1e-5).sqrt()
        return Gaussian(mean, (_LEAST_SIGMA + (1 - _LEAST_SIGMA) * torch.sigmoid(raw)).log())

    def infer_own(
        self, ahead: Float[Tensor, "2 batch frames size"], encoded: Float[Tensor, "2 batch width"]
    ) -> Gaussian:
        """Tell a frame's from the true frames ahead, normalised, in each side's sense of time."""
        return Gaussian.of(self.next(torch.cat([ahead.flatten(-2), encoded], dim=-1)))


_MEMORY = 0.7165  # exp(-1/3): what a frame's noise keeps of the frame before, so that it changes over three frames


@dataclass(eq=False)
class DrawnLatents:
    """Latents from noise drawn before; with zeros the mean answer."""

    shared: Float[Tensor, "batch shared"]  # standard normal
    slow: Float[Tensor, "2 batch generated own"]  # noise of unit variance, slow over frames

    @staticmethod
    def calm(config: StitcherConfig, batch: int, frames: int) -> "DrawnLatents":
        """At the mean, for transitions of so many frames."""
        generated = count_generated(frames)
        return DrawnLatents(torch.zeros(batch, config.shared), torch.zeros(2, batch, generated, config.own))

    @staticmethod
    def sample(config: StitcherConfig, batch: int, frames: int, generator: torch.Generator) -> "DrawnLatents":
        """Drawn, for transitions of so many frames; a frame's noise keeps a share of that of the frame before."""
        shared = torch.randn(batch, config.shared, generator=generator)
        white = torch.randn(2, batch, count_generated(frames), config.own, generator=generator)
        slow = [white[:, :, 0]]
        for frame in range(1, white.shape[2]):
            slow.append(_MEMORY * slow[-1] + (1 - _MEMORY**2) ** 0.5 * white[:, :, frame])
        return DrawnLatents(shared, torch.stack(slow, dim=2))

    def still(self, rows: Bool[Tensor, " batch"]) -> "DrawnLatents":
        """Return the same with some rows at the mean."""
        drawn = (~rows).float()
        return DrawnLatents(self.shared * drawn[:, None], self.slow * drawn[:, None, None])

    def scale(self, temperature: float) -> "DrawnLatents":
        """Return the same with noise of another standard deviation."""
        return DrawnLatents(temperature * self.shared, temperature * self.slow)

    def rows(self, index: Int[Tensor, " rows"]) -> "DrawnLatents":
        """Return some rows."""
        return DrawnLatents(self.shared[index], self.slow[:, index])

    def put(self, index: Int[Tensor, " rows"], other: "DrawnLatents") -> "DrawnLatents":
        """Return the same with other latents in some rows."""
        return DrawnLatents(self.shared.index_copy(0, index, other.shared), self.slow.index_copy(1, index, other.slow))

    def share(self, prior: Gaussian) -> Float[Tensor, "batch shared"]:
        """Latent that both sides share over the transition."""
        return prior.draw(self.shared)

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        """A frame's, of both sides."""
        return prior.draw(self.slow[:, :, step])


_OVERLAP_SHARE, _MOST_OVERLAP = 8, 6  # K is so much of the frames, and no more


@dataclass(frozen=True, eq=False)
class Ends:
    """Known frames of a transition: its two ends, and frames before the one and after the other."""

    features: Float[Tensor, "2 batch context size"]  # frames up to each side's end, in its sense of time
    present: Float[Tensor, "2 batch context"]  # 1 where there is such a frame; those before the last without a gap
    position: Float[Tensor, "batch 2"]  # of the second end over the ground, seen from the first, metres
    turn: Float[Tensor, "batch"]  # by how much its heading is another, radians

    @staticmethod
    def of(
        before: Float[Tensor, "batch before size"],
        after: Float[Tensor, "batch after size"],
        position: Tensor,
        turn: Tensor,
    ) -> "Ends":
        """Make them of the known frames up to each end, in its side's own sense of time."""
        context, sides, present = max(before.shape[1], after.shape[1]), [], []
        for known in (before, after):
            lead = context - known.shape[1]
            sides.append(torch.cat([known[:, :1].expand(-1, lead, -1), known], dim=1))
            present.append((torch.arange(context) >= lead).float().expand(len(known), -1))
        return Ends(torch.stack(sides), torch.stack(present), position, turn)

    def with_mirror_image(self) -> "Ends":
        """Return these pairs of poses, then their mirror images."""
        return Ends(
            torch.cat([self.features, mirror_features(self.features)], dim=1),
            self.present.repeat(1, 2, 1),
            torch.cat([self.position, self.position * self.position.new_tensor([-1.0, 1.0])]),
            torch.cat([self.turn, -self.turn]),
        )

    def frame(self, number: int) -> Frame:
        """Return a frame, of which change and pace are known where the one before is; negative counts from the end."""
        now, before = self.features[:, :, number], number % self.features.shape[2] - 1
        if before < 0:
            return Frame(now, torch.zeros_like(now[..., POSE]), torch.zeros_like(self.present[:, :, 0]))
        return Frame(now, (now - self.features[:, :, before])[..., POSE], self.present[:, :, before])


@dataclass(frozen=True, eq=False)
class Sides:
    """Frames generated by both sides, each from its own end on."""

    frames: int  # from one pose to the other
    features: Float[Tensor, "sides batch generated size"]  # in its own sense of time; contacts are probabilities
    logits: Float[Tensor, "sides batch generated 2"]  # logits of the contacts
    position: Float[Tensor, "sides batch generated 2"]  # ground position of the hips, metres, relative to the first end
    heading: Float[Tensor, "sides batch generated"]  # heading of the hips, radians, likewise
    phases: Float[Tensor, "sides batch generated 4"]  # phases of the generated frames
    at_ends: Float[Tensor, "sides batch 4"]  # phases of the ends themselves

    def place_joints(self) -> Float[Tensor, "sides batch generated joints 3"]:
        """Place the joints, metres, seen from the first end."""
        return BodyPose.of_features_at(self.features, self.position, self.heading).joints_world()


def count_generated(frames: int) -> int:
    """Count the frames that each side of a transition makes: up to the middle and K beyond it, an eighth of the
    transition and 6 at most, which the paper leaves open; one at least is generated by both."""
    beyond = min(round(frames / _OVERLAP_SHARE), _MOST_OVERLAP)
    return min(max(frames // 2 + beyond, (frames + 1) // 2), frames - 1)


def walk_sides(network: StitcherNetwork, ends: Ends, frames: int, latents: DrawnLatents) -> Sides:
    """Walk both sides of a transition of so many frames from pose to pose until they overlap."""
    return StepwiseWork(walk_stepwise(network, ends, frames, latents)).finish()


def walk_stepwise(
    network: StitcherNetwork, ends: Ends, frames: int, latents: DrawnLatents
) -> Generator[None, None, Sides]:
    """Walk both sides as `walk_sides`, a frame at a time."""
    zero = torch.zeros_like(ends.position)
    end, ends_at = ends.frame(-1), GroundPose(torch.stack([zero, ends.position]), torch.stack([zero[:, 0], ends.turn]))
    memory, shared = yield from _enter(network, ends, ends_at, frames, latents)
    here, at, first_phase, rows = end, ends_at, memory.phase, []
    for step in range(count_generated(frames)):
        # Towards the other side, or towards the far end once they have met.
        left, target, target_at = frames - 2 * step, here, at
        if left < 1:
            left, target, target_at = frames - step, end, ends_at
        situation = Situation.of(here, at, target, target_at, float(left))
        seen = network.embed(situation)
        arrived = torch.full_like(here.paced, step / (step + left))
        encoded, encoder, prior = network.encode(seen, situation, memory, arrived)
        latent = torch.cat([shared.expand(2, -1, -1), latents.own(prior, encoded, step)], dim=-1)
        now, logits, memory = network.decode(seen, encoded, latent, situation, memory, encoder)
        at = at.displace(*_pick_pace(now))
        here = Frame(now, (now - here.features)[..., POSE], torch.ones_like(here.paced))
        yield
        rows.append((now, logits, at.position_xz, at.heading, memory.phase))
    columns = (torch.stack(column, dim=2) for column in zip(*rows, strict=True))
    return Sides(frames, *columns, at_ends=first_phase)


def _enter(
    network: StitcherNetwork, ends: Ends, at: GroundPose, frames: int, latents: DrawnLatents
) -> Generator[None, None, tuple[Memory, Float[Tensor, "batch shared"]]]:
    """Walk through the frames before each end; returns the memory there and the shared latent."""
    context, end, grounds = ends.features.shape[2], ends.frame(-1), [at]
    for number in range(context - 1, 0, -1):
        grounds.insert(0, grounds[0].before(*_pick_pace(ends.features[:, :, number])))

    def look(number: int) -> Situation:
        return Situation.of(ends.frame(number), grounds[number], end, at, float(frames + context - 1 - number))

    first = network.embed(look(context - 1))
    shared = latents.share(network.infer_shared(first))
    memory, before = network.begin(first), torch.zeros_like(ends.present[:, :, 0])
    for number in range(context - 1):
        there = ends.present[:, :, number]
        situation = look(number)
        seen = network.embed(situation)
        memory = network.begin(seen).keep(memory, 1 - before)
        encoded, encoder, prior = network.encode(seen, situation, memory, torch.zeros_like(there))
        latent = torch.cat([shared.expand(2, -1, -1), prior.mean], dim=-1)
        after = network.decode(seen, encoded, latent, situation, memory, encoder)[2]
        memory, before = after.keep(memory, there), there
        yield
    if context > 1:
        memory = network.begin(first).keep(memory, 1 - before)
    return memory, shared


def _pick_pace(features: Float[Tensor, "*batch size"]) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    return LAYOUT.pick(features, "root_displacement_heading"), LAYOUT.pick(features, "heading_change")[..., 0]


@dataclass(frozen=True, eq=False)
class Joined:
    """The frames between two poses, seen from the first."""

    root_position: Float[Tensor, "batch frames 3"]  # position of the hips, metres
    quats: Float[Tensor, "batch frames joints 4"]  # local rotations
    contacts: Float[Tensor, "batch frames 2"]  # logits of planted toes
    apart: Float[Tensor, " batch"]  # mean distance of the sides' joints amid their overlap, metres (MMPE)

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return bool(self.root_position.isfinite().all() & self.quats.isfinite().all())


def join_sides(sides: Sides) -> Joined:
    """Join the sides of a transition of two frames or more."""
    generated = sides.features.shape[2]
    first, last = sides.frames - generated, generated  # of the overlap, counted from the first pose
    if first > last:
        raise ValueError("sides that have no frame in common cannot be joined")
    bodies = [
        BodyPose.of_features_at(*each) for each in zip(sides.features, sides.position, sides.heading, strict=True)
    ]
    seam = (first + last) // 2
    index = [seam - 1, sides.frames - 1 - seam]  # the same frame, as each side counts
    pairs = [body.slice(at, at + 1) for body, at in zip(bodies, index, strict=True)]
    apart = (pairs[0].joints_world() - pairs[1].joints_world()).norm(dim=-1).mean(dim=(1, 2))
    miss = (pairs[1].root_position - pairs[0].root_position)[:, 0, ::2]
    twist = rotations.wrap_angle(pairs[1].heading - pairs[0].heading)[:, 0]
    rows = []
    for side, body in enumerate(bodies):
        order = torch.arange(generated) if side == 0 else torch.arange(generated - 1, -1, -1)
        share = ((order + 1) / (sides.frames / 2)).clamp_max(1)
        share = share * share * (3 - 2 * share) * (0.5 if side == 0 else -0.5)  # no leap of speed at either end
        quats = body.local_quat_xyzw[:, order]
        hips = rotations.multiply(rotations.about_y(share * twist[:, None]), quats[..., 0, :])
        quats = torch.cat([hips[..., None, :], quats[..., 1:, :]], dim=-2)
        root = body.root_position[:, order] + rotations.lift_ground(share[:, None] * miss[:, None])
        rows.append((root, quats, sides.logits[side][:, order]))
    root, quats, logits = (_blend(one, other, first, last) for one, other in zip(*rows, strict=True))
    return Joined(root, quats, logits, apart)


def _blend(one: Tensor, other: Tensor, first: int, last: int) -> Tensor:
    """Take the first side up to the overlap, the second after it, and an even blend between (slerp of quaternions)."""
    count = last - first + 1
    share = (torch.arange(1, count + 1, dtype=one.dtype) / (count + 1))[None, :, None]
    a, b = one[:, first - 1 : last], other[:, :count]
    mixed = rotations.slerp(a, b, share.expand(a.shape[:-1])) if one.ndim == 4 else torch.lerp(a, b, share)
    return torch.cat([one[:, : first - 1], mixed, other[:, count:]], dim=1)


SOURCE = "stitcher"
"""Name of the in-betweener in notes."""
MAX_CONTEXT = 10
"""Frames before a gap, and after it, that are looked at."""
_WIDENED = 1.25
"""By how much draws are wider than what training found, with which the best of eight is nearest to the truth: answers
differ by as much more, and the best of eight is hardly farther from the truth."""
_CHUNK, _LARGEST_SEED = 16, 2**63
"""Draws whose noise comes from one seed, and a bound of seeds."""
_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False, repr=False)
class Stitcher(checkpoints.NetworkModel[StitcherNetwork], Inbetweener):
    """A trained stitcher (Ren et al. 2024)."""

    kind, parts = "stitcher", (StitcherNetwork, StitcherConfig)

    seed: int | None = None
    """Seed of its draws; without one the answer is the mean one, with the latent at its mean."""
    number: int = 0
    """Number of the draw that it proposes."""

    @property
    def longest(self) -> int:
        """Frames of the longest gap that it fills."""
        return self.network.config.longest - 1

    def drawing(self, seed: int = 0, number: int = 0) -> "Stitcher":
        """Return the in-betweener that proposes the draw of a number, from 0 on, with a seed. The noise is a quarter
        wider than that of the weights."""
        return replace(self, seed=seed, number=number)

    @torch.no_grad()
    def answer(self, ends: Ends, frames: int) -> Joined:
        """Return the calm answer to pairs of poses: the mean of that to them and that to their mirror image."""
        batch = len(ends.position)
        calm = DrawnLatents.calm(self.network.config, 2 * batch, frames)
        joined = join_sides(walk_sides(self.network, ends.with_mirror_image(), frames, calm))
        return _average_mirrored(joined, batch)

    @torch.no_grad()
    def draw(self, ends: Ends, start: int, frames: int, seed: int) -> Joined:
        """Return the draw of this number with a seed, for the ends of a gap that starts at a frame."""
        chunk, row = divmod(self.number, _CHUNK)
        generator = torch.Generator().manual_seed((seed + 1_000_003 * start + 7_919 * chunk) % _LARGEST_SEED)
        drawn = DrawnLatents.sample(self.network.config, _CHUNK, frames, generator).rows(torch.tensor([row]))
        latents = drawn.scale(_WIDENED * float(self.network.temperature))
        return join_sides(walk_sides(self.network, ends, frames, latents))

    @torch.no_grad()
    def connect(
        self,
        before: Float[Tensor, "before size"],
        after: Float[Tensor, "batch after size"],
        position: Float[Tensor, "batch 2"],
        turn: Float[Tensor, " batch"],
        frames: int,
    ) -> Generator[None, None, Float[Tensor, "batch frames size"]]:
        """Generate, a frame at a time, the mean transitions from the last frame of `before` to the last of `after`, run
        backwards, `frames` later, as features from the next frame to that one. Relative to the first it is at
        `position`, metres, with its heading turned by `turn`, radians. The other frames of both are context."""
        before = before[-1 - MAX_CONTEXT :].expand(len(after), -1, -1)
        after = after[:, -1 - MAX_CONTEXT :]
        latents = DrawnLatents.calm(self.network.config, len(after), frames)
        ends = Ends.of(before, after, position, turn)
        joined = join_sides((yield from walk_stepwise(self.network, ends, frames, latents)))
        origin = GroundPose(torch.zeros_like(position), torch.zeros_like(turn))
        first, last = (
            BodyPose.of_features_at(known[:, -1:], at.position_xz[:, None], at.heading[:, None])
            for known, at in ((before, origin), (after, GroundPose(position, turn)))
        )
        root = torch.cat([first.root_position, joined.root_position, last.root_position], dim=1)
        quats = torch.cat([first.local_quat_xyzw, joined.quats, last.local_quat_xyzw], dim=1)
        planted = torch.cat([(joined.contacts > 0).float(), after[:, -1:, LAYOUT.slices["contacts"]]], dim=1)
        transitions = [
            encode(Motion(CANONICAL, Fraction(PRIOR_FPS), one.double(), rotations.make_sign_continuous(two.double())))[
                0
            ][1:]
            for one, two in zip(root, quats, strict=True)
        ]
        return torch.cat([torch.stack(transitions).float()[..., : LAYOUT.continuous], planted], dim=-1)

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose motion for gaps between whole poses of up to `longest` frames; all else stays interpolated, and the
        proposal notes it. Frames beside a gap that are wholly known, up to MAX_CONTEXT of them, are looked at. Draws
        have a seed of their own; partial keys are not seen."""
        query = query.hide_partial_keys()
        body = query.to_unit_size(query.motion)
        toes = body.joint_positions()[:, list(TOE_JOINTS)]
        root, quats = body.root_position.clone(), body.local_quat_xyzw.clone()
        logits = contacts.to_logits(contacts.detect_contacts(toes, PRIOR_FPS)).float()
        sources = _list_partly_known(query)
        for start, stop in query.enclosed_gaps:
            if reason := self._refuse(query, start, stop):
                sources.append(GapSource(start, stop, INTERPOLATION, reason))
                continue
            ends, frames = see_ends(body, query.missing.frames, start, stop), stop - start + 1
            found = self.answer(ends, frames) if self.seed is None else self.draw(ends, start, frames, self.seed)
            if not found.finite:
                sources.append(GapSource(start, stop, INTERPOLATION, "nothing finite came of it"))
                continue
            part = slice(start, stop)
            root[part], quats[part] = _place(found, body, start)
            logits[part] = found.contacts[0]
            sources.append(GapSource(start, stop, SOURCE, apart=query.scale * float(found.apart[0])))
        moved = replace(body, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))
        return Proposal(query.to_character(moved), logits, SOURCE, tuple(sources))

    def _refuse(self, query: GapQuery, start: int, stop: int) -> str:
        """Return why a gap is not stitched; empty where it is."""
        if stop - start > self.longest:
            return f"longer than the {self.longest} frames that the {SOURCE} fills"
        edges = query.missing.joints[[start - 1, stop]].any() | query.missing.root[[start - 1, stop]].any()
        if bool(edges) or query.loose is not None:
            return f"known in part, where the {SOURCE} takes whole poses"
        return "along a trajectory, which it does not take" if query.keep_trajectory else ""


def see_ends(body: Motion, missing: Tensor, start: int, stop: int) -> Ends:
    """See the ends of a gap in a motion of unit size, and whole frames beside it, of which `missing` has none."""
    before, after = _count_known(missing, start - 1, -1), _count_known(missing, stop, 1)
    there = _encode(body, start - 1 - before, start)[-1 - before :]
    back = reversed_features(_encode(body, stop, stop + 1 + after))[-1 - after :]
    heading = rotations.split_heading(body.local_quat_xyzw[[start - 1, stop], 0])[0]
    away = (body.root_position[stop] - body.root_position[start - 1])[[0, 2]]
    position = rotations.rotate_ground(away, -heading[0]).float()[None]
    turn = rotations.wrap_angle(heading[1] - heading[0]).float()[None]
    return Ends.of(there.float()[None], back.float()[None], position, turn)


def _count_known(missing: Tensor, at: int, step: int) -> int:
    """Count whole frames beyond one, up to MAX_CONTEXT."""
    count = 0
    while count < MAX_CONTEXT and 0 <= at + step < len(missing) and not bool(missing[at + step]):
        at, count = at + step, count + 1
    return count


def _encode(body: Motion, start: int, stop: int) -> Float[Tensor, "frames size"]:
    """Encode frames; a single one stands still, which nobody looks at."""
    part = body.slice(start, stop)
    if stop - start == 1:
        part = replace(
            part, root_position=part.root_position.expand(2, -1), local_quat_xyzw=part.local_quat_xyzw.expand(2, -1, -1)
        )
    return encode(part)[0]


def _place(
    joined: Joined, body: Motion, start: int
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 4"]]:
    """Place an answer after the pose before a gap, double precision."""
    facing = rotations.split_heading(body.local_quat_xyzw[start - 1 : start, 0])[0]
    at = body.root_position[start - 1] * torch.tensor([1.0, 0.0, 1.0]).double()
    root, quats = joined.root_position[0].double(), joined.quats[0].double().clone()
    turn = rotations.about_y(facing).expand(len(root), 4)
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    return rotations.rotate(turn, root) + at, quats


def _average_mirrored(joined: Joined, batch: int) -> Joined:
    """Average answers and, mirrored back, those to the mirror image."""
    flip, turned = joined.root_position.new_tensor([-1.0, 1.0, 1.0]), joined.quats.new_tensor([1.0, -1.0, -1.0, 1.0])
    root = (joined.root_position[:batch] + flip * joined.root_position[batch:]) / 2
    one, other = joined.quats[:batch], turned * joined.quats[batch:, :, _PARTNERS]
    quats = rotations.slerp(one, other, one.new_full(one.shape[:-1], 0.5))
    logits = (joined.contacts[:batch] + joined.contacts[batch:].flip(-1)) / 2
    return Joined(root, quats, logits, (joined.apart[:batch] + joined.apart[batch:]) / 2)


def _list_partly_known(query: GapQuery) -> list[GapSource]:
    """List runs of frames that are known in part, or have nothing known on one side."""
    rest = query.missing.frames.clone()
    for start, stop in query.enclosed_gaps:
        rest[start:stop] = False
    reason = f"known in part or on one side alone, where the {SOURCE} takes whole poses"
    return [GapSource(start, stop, INTERPOLATION, reason) for _, start, stop in true_intervals(rest[:, None])]
