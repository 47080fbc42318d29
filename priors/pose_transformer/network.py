"""The pose transformer: a network that corrects the interpolation of a partly known motion, in rotations.

Every frame is a token. A token tells the interpolated pose, seen from the interpolated hips (over the ground, along the
heading), so the answer turns and moves with its input; what of it is known; and how far the known frames are. The
output is added to the interpolation where that is not known: six numbers for each joint's rotation (Zhou et al. 2019),
the hips' place, and two contacts. Bones are rigid by construction.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.partial_motion import EFFECTORS, KnownParts, PartialMotion, interpolate_partial_motion
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.skeleton import CANONICAL
from priors.config import NetworkConfig

_JOINTS = CANONICAL.num_joints
_ROTATION_ROWS = 6 * _JOINTS
_FLAG_ROWS = _JOINTS + 4
_TARGET_ROWS = 4 * len(EFFECTORS)
_TIME_ROWS = 3 * 2 * 3
_TRAVEL_ROWS = 4
_ROWS = _ROTATION_ROWS + 6 * _JOINTS + 1 + _FLAG_ROWS + _TARGET_ROWS + 2 + _TIME_ROWS + _TRAVEL_ROWS
_OUT_ROWS = _ROTATION_ROWS + 3 + 2
_STEP_UNIT, _TURN_UNIT, _TARGET_UNIT, _BONE_UNIT, _HIPS_UNIT = 0.05, 0.05, 0.2, 0.03, 0.1  # metres, radians
_TRAVEL_UNIT = 2.0  # metres
_NEAR_FRAMES, _FAR_FRAMES = 5.0, 120.0  # frames: scales of the time to a known frame
QUANTILES = (0.5, 0.9)
"""Shares of errors that the two spreads are to contain."""


@dataclass(frozen=True)
class PoseTransformerConfig(NetworkConfig):
    """Shape of the network."""

    width: int = 256
    """Numbers of a token; a multiple of twice the heads."""
    layers: int = 5
    """Layers of attention."""
    heads: int = 8
    """Heads of each."""
    kernel: int = 5
    """Frames of each layer's convolution, one number at a time, before its attention; odd, 0 for none."""
    detail: int = 0
    """Layers of attention of a second stage, which corrects what the first proposes; the attention of the first is then
    to frames alone in which a rotation, the hips' place or a target is known (context and detail transformer of Qin et
    al. 2022, here with this network's tokens, rotary positions and losses). 0 for none."""

    def __post_init__(self):
        if min(self.width, self.layers, self.heads) < 1 or self.width % (2 * self.heads):
            raise RequestError(f"a pose transformer needs layers and a width of whole pairs a head, got {self}")
        if self.kernel and self.kernel % 2 == 0:
            raise RequestError(f"a pose transformer's kernel must be odd, got {self.kernel}")


@dataclass(frozen=True, eq=False)
class ProposedPoses:
    """Poses that the network proposes for a partial motion; known values are those of its input."""

    root_position: Float[Tensor, "batch frames 3"]
    """World position of the hips, metres."""
    local_matrix: Float[Tensor, "batch frames joints 3 3"]
    """Local rotations; the hips' is their world rotation."""
    contacts: Float[Tensor, "batch frames 2"]
    """Contact logits of the left and the right toe."""
    log_spread: Float[Tensor, "batch frames joints 2"]
    """Logarithm of the distance, metres, within which a joint's true position lies with the chances QUANTILES."""
    rough: "ProposedPoses | None" = None
    """What the first of two stages proposed."""

    def poses(self, offsets: Float[Tensor, "batch joints 3"]) -> tuple[Tensor, Tensor]:
        """Return world positions, metres, and world rotation matrices of all joints on these bones."""
        positions, world = kinematics.chain_matrices(offsets[:, None], CANONICAL.parents, self.local_matrix)
        return positions + self.root_position[..., None, :], world


class PoseTransformerNetwork(nn.Module):
    """A partial motion in, poses out; it normalises inside."""

    mean_quats: Tensor
    mean_rotation: Tensor
    std_rotation: Tensor
    mean_position: Tensor
    std_position: Tensor
    spread_shift: Tensor

    def __init__(self, config: PoseTransformerConfig, *, bfloat16: bool = False):
        """Compute attention and perceptrons in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config, bfloat16
        self.register_buffer("mean_quats", torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(_JOINTS, 4).clone())
        self.register_buffer("mean_rotation", torch.zeros(_JOINTS, 6))
        self.register_buffer("std_rotation", torch.ones(_JOINTS, 6))
        self.register_buffer("mean_position", torch.zeros(_JOINTS, 3))
        self.register_buffer("std_position", torch.ones(_JOINTS, 3))
        self.register_buffer("spread_shift", torch.zeros(2))
        width = config.width
        self.bones = nn.Linear(3 * _JOINTS, width, bias=False)
        self.embed = nn.Sequential(nn.Linear(_ROWS, width), nn.GELU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.layers))
        self.norm, self.head = nn.LayerNorm(width), _make_head(width)
        self.spread = nn.Sequential(nn.Linear(width, width // 2), nn.GELU(), nn.Linear(width // 2, 2 * _JOINTS))
        self.detail = _Detail(config) if config.detail else None

    def forward(self, motion: PartialMotion) -> ProposedPoses:
        """Propose poses for an interpolated motion."""
        shown = rotations.to_matrix(motion.quats)
        if self.detail is None:
            return self._propose(motion, shown, self)
        seen = motion.known.rotations.any(dim=-1) | motion.known.ground | motion.known.effectors.any(dim=-1)
        seen = seen | ~seen.any(dim=1, keepdim=True)
        rough = self._propose(motion, shown, self, seen)
        # Rotations are shown from the interpolated heading.
        hips = _about_y(-motion.heading) @ rough.local_matrix[..., 0, :, :]
        shown = torch.cat([hips.unsqueeze(-3), rough.local_matrix[..., 1:, :, :]], dim=-3)
        contacts = torch.where(motion.contacts == 0.5, torch.sigmoid(rough.contacts), motion.contacts)
        corrected = replace(motion, root_position=rough.root_position, contacts=contacts)
        return replace(self._propose(corrected, shown, self.detail), rough=rough)

    def _propose(
        self,
        motion: PartialMotion,
        shown: Float[Tensor, "batch frames joints 3 3"],
        stage: "PoseTransformerNetwork | _Detail",
        seen: Bool[Tensor, "batch frames"] | None = None,
    ) -> ProposedPoses:
        """Propose poses with the layers of a stage, which look at the `seen` frames alone."""
        rows = self._encode(motion, shown)
        bones = (motion.offsets - CANONICAL.offsets.to(motion.offsets)).flatten(1) / _BONE_UNIT
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            tokens = stage.embed(rows) + self.bones(bones)[:, None]
            phases = _rotary_phases(rows.shape[1], self.config.width // self.config.heads, tokens.device)
            for layer in stage.layers:
                tokens = layer(tokens, phases, seen)
            tokens = stage.norm(tokens)
            out, spread = stage.head(tokens).float(), self.spread(tokens.detach()).float()
        local = self._decode_rotations(out[..., :_ROTATION_ROWS], shown, motion)
        moved = out[..., _ROTATION_ROWS : _ROTATION_ROWS + 3] * _HIPS_UNIT
        moved = rotations.rotate_about_y(moved, motion.heading)
        keep = torch.stack([motion.known.ground, motion.known.height, motion.known.ground], dim=-1)
        root = motion.root_position + torch.where(keep, 0.0, moved)
        logits = 4 * out[..., -2:]
        return ProposedPoses(root, local, logits, spread.unflatten(-1, (_JOINTS, 2)) - 3.0 + self.spread_shift)

    def interpolate(self, motion: PartialMotion) -> PartialMotion:
        """Interpolate a motion where it is not known, as the network takes it."""
        return interpolate_partial_motion(motion, self.mean_quats, float(self.mean_position[0, 1]))

    def _encode(self, motion: PartialMotion, shown: Float[Tensor, "batch frames joints 3 3"]) -> Tensor:
        """Encode what is shown and what is known, in about unit size."""
        known = motion.known
        six = (rotations.to_six(shown) - self.mean_rotation) / self.std_rotation
        local, _ = kinematics.chain_matrices(motion.offsets[:, None], CANONICAL.parents, shown)
        local = local + motion.root_position[..., None, :] * local.new_tensor([0.0, 1.0, 0.0])
        ground = rotations.lift_ground(motion.root_position[..., ::2])[..., None, :]
        world = rotations.rotate_about_y(local, motion.heading[..., None]) + ground
        step = rotations.rotate_about_y(_difference(world), -motion.heading[..., None]) / _STEP_UNIT
        turn = _difference(motion.heading[..., None]) / _TURN_UNIT
        aim = rotations.rotate_about_y(motion.targets - world[..., list(EFFECTORS), :], -motion.heading[..., None])
        aim = torch.where(known.effectors[..., None], aim / _TARGET_UNIT, 0.0)
        places = (local - self.mean_position) / self.std_position
        flags = _encode_flags(known)
        return torch.cat(
            [
                *(each.flatten(-2) for each in (six, places, step, aim)),
                turn,
                2 * motion.contacts - 1,
                flags,
                _encode_times(known),
                _encode_travel(motion),
            ],
            dim=-1,
        )

    def _decode_rotations(
        self,
        out: Float[Tensor, "batch frames rows"],
        shown: Float[Tensor, "batch frames joints 3 3"],
        motion: PartialMotion,
    ) -> Float[Tensor, "batch frames joints 3 3"]:
        """Return local rotations with corrections where they are not known; the hips' in the world."""
        six = rotations.to_six(shown) + out.unflatten(-1, (_JOINTS, 6)) * self.std_rotation
        made = rotations.from_six(six)
        known = motion.known.rotations
        others = torch.where(known[..., 1:, None, None], shown[..., 1:, :, :], made[..., 1:, :, :])
        tilt, free, faced = made[..., 0, :, :], ~known[..., 0], motion.known.heading
        # Of hips of which either heading or tilt is known, that is kept, and the other proposed.
        turn = _heading_of(torch.where((free == faced)[..., None, None], tilt, torch.eye(3, device=tilt.device)))
        tilted = _about_y(-turn) @ tilt
        turned = _about_y(turn - _heading_of(shown[..., 0, :, :])) @ shown[..., 0, :, :]
        hips = torch.where((free & faced)[..., None, None], tilted, tilt)
        hips = torch.where((~free & ~faced)[..., None, None], turned, hips)
        hips = torch.where((~free & faced)[..., None, None], shown[..., 0, :, :], hips)
        return torch.cat([(_about_y(motion.heading) @ hips).unsqueeze(-3), others], dim=-3)


class _Detail(nn.Module):
    """Layers of the second stage."""

    def __init__(self, config: PoseTransformerConfig):
        super().__init__()
        width = config.width
        self.embed = nn.Sequential(nn.Linear(_ROWS, width), nn.GELU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.detail))
        self.norm, self.head = nn.LayerNorm(width), _make_head(width)


class _Layer(nn.Module):
    """Attention among all frames, and a perceptron for each."""

    def __init__(self, config: PoseTransformerConfig):
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.first, self.second = nn.LayerNorm(width), nn.LayerNorm(width)
        self.split, self.join = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.perceptron = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.near = (
            nn.Conv1d(width, width, config.kernel, padding=config.kernel // 2, groups=width) if config.kernel else None
        )

    def forward(
        self, tokens: Tensor, phases: tuple[Tensor, Tensor], seen: Bool[Tensor, "batch frames"] | None = None
    ) -> Tensor:
        if self.near is not None:
            tokens = tokens + self.near(tokens.transpose(1, 2)).transpose(1, 2)
        parts = self.split(self.first(tokens)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        query, key, value = parts.float().unbind()
        mask = None if seen is None else seen[:, None, None]
        # Attention itself is slower in bfloat16 on a CPU.
        with torch.autocast(tokens.device.type, enabled=False):
            query, key = _rotate_pairs(query, phases), _rotate_pairs(key, phases)
            mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        tokens = tokens + self.join(mixed.transpose(1, 2).flatten(2))
        return tokens + self.perceptron(self.second(tokens))


def _make_head(width: int) -> nn.Linear:
    """Make a layer that puts out nothing at first."""
    head = nn.Linear(width, _OUT_ROWS)
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


def _rotary_phases(frames: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return cosines and sines of rotary position embedding (Su et al. 2021), slowest turn over about 600 frames."""
    rates = torch.exp(-math.log(100.0) * torch.arange(0, width, 2, device=device) / width)
    angles = torch.arange(frames, device=device)[:, None] * rates
    return torch.cos(angles), torch.sin(angles)


def _rotate_pairs(vectors: Float[Tensor, "batch heads frames width"], phases: tuple[Tensor, Tensor]) -> Tensor:
    (cosine, sine), (one, other) = phases, vectors.chunk(2, dim=-1)
    return torch.cat([one * cosine - other * sine, one * sine + other * cosine], dim=-1)


def _heading_of(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the heading about +Y, radians."""
    return torch.atan2(matrix[..., 0, 2] - matrix[..., 2, 0], matrix[..., 0, 0] + matrix[..., 2, 2])


def _about_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    zero, one, sine, cosine = torch.zeros_like(angle), torch.ones_like(angle), torch.sin(angle), torch.cos(angle)
    return torch.stack([cosine, zero, sine, zero, one, zero, -sine, zero, cosine], dim=-1).unflatten(-1, (3, 3))


def _difference(values: Float[Tensor, "batch frames *rest"]) -> Float[Tensor, "batch frames *rest"]:
    return torch.diff(values, dim=1, prepend=values[:, :1])


def _encode_flags(known: KnownParts) -> Float[Tensor, "batch frames flags"]:
    told = torch.stack([known.heading, known.ground, known.height, known.path], dim=-1)
    return torch.cat([known.rotations, told, known.effectors], dim=-1).float()


def _encode_travel(motion: PartialMotion) -> Float[Tensor, "batch frames 4"]:
    """Encode where the hips are and face, seen from the first frame."""
    ground, facing = motion.root_position[..., ::2], motion.heading
    travelled = rotations.rotate_ground(ground - ground[:, :1], -facing[:, :1]) / _TRAVEL_UNIT
    turned = facing - facing[:, :1]
    return torch.cat([travelled, torch.sin(turned)[..., None], torch.cos(turned)[..., None]], dim=-1)


def _encode_times(known: KnownParts) -> Float[Tensor, "batch frames times"]:
    """Encode frames since and until a rotation, the hips' place, and a target were known, each on three scales."""
    told = (known.rotations.any(dim=-1), known.ground, known.effectors.any(dim=-1))
    return torch.cat([_encode_distance(each) for each in told], dim=-1)


def _encode_distance(known: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames 6"]:
    frame = torch.arange(known.shape[1], device=known.device)
    before, after = frame - last_observed(known), next_observed(known) - frame
    none = ~known.any(dim=1)[:, None]
    far = torch.stack(
        [torch.where((each < 0) | none, 2 * _FAR_FRAMES, each.float()) for each in (before, after)], dim=-1
    )
    near = torch.exp(-far / _NEAR_FRAMES)
    return torch.cat([far.clamp(max=2 * _FAR_FRAMES) / _FAR_FRAMES, torch.log1p(far) / 3 - 0.7, near], dim=-1)
