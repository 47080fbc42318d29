"""The pose transformer: a network that corrects the interpolation of a partly known motion, in rotations.

Every frame is a token. A token holds the interpolated pose, seen from the interpolated hips (over the ground, along the
heading), so the answer turns and moves with its input; what of it is known; and how far the known frames are. The
output is added to the interpolation where that is not known: six numbers for each joint's rotation (Zhou et al. 2019),
the hips' position, and two contacts. Bones are rigid by construction.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from mapctl import contacts, kinematics, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, interpolate_partial_motion
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.numerics.intervals import count_frames_to_observed, true_intervals
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size

_JOINTS = CANONICAL.num_joints
_ROTATION_ROWS = 6 * _JOINTS
_FLAG_ROWS = _JOINTS + 4
_TARGET_ROWS = 16  # of offsets of hands and feet from targets in single frames: the bundled weights have rows for these
_TIME_ROWS = 3 * 2 * 3
_TRAVEL_ROWS = 4
_ROWS = _ROTATION_ROWS + 6 * _JOINTS + 1 + _FLAG_ROWS + _TARGET_ROWS + 2 + _TIME_ROWS + _TRAVEL_ROWS
_OUT_ROWS = _ROTATION_ROWS + 3 + 2
_STEP_UNIT, _TURN_UNIT, _BONE_UNIT, _HIPS_UNIT = 0.05, 0.05, 0.03, 0.1  # metres, radians
_TRAVEL_UNIT = 2.0  # metres
_NEAR_FRAMES, _FAR_FRAMES = 5.0, 120.0  # frames: scales of the time to a known frame
QUANTILES = (0.5, 0.9)
"""Shares of errors that the two spreads are to contain."""


@dataclass(frozen=True)
class PoseTransformerConfig(NetworkConfig):
    """Shape of the network."""

    width: Size = 192
    """Numbers of a token; a multiple of twice the heads."""
    layers: Size = 3
    """Layers of attention of the first stage, to frames alone in which a rotation, the hips' position or a target is
    known (context and detail transformer of Qin et al. 2022, with this network's tokens, rotary positions and losses).
    """
    heads: Size = 6
    """Heads of each."""
    kernel: Size = 5
    """Frames of each layer's convolution, one number at a time, before its attention; odd."""
    detail: Size = 3
    """Layers of attention of the second stage, which corrects what the first proposes."""

    def __post_init__(self):
        if self.width % (2 * self.heads):
            raise RequestError(f"a pose transformer needs a width of whole pairs a head, got {self}")
        if self.kernel % 2 == 0:
            raise RequestError(f"a pose transformer's kernel must be odd, got {self.kernel}")


@dataclass(frozen=True, eq=False)
class ProposedPoses:
    """Poses that the network proposes for a partial motion; known values are those of its input."""

    root_position: Float[Tensor, "batch frames 3"]  # world position of the hips, metres
    local_matrix: Float[Tensor, "batch frames joints 3 3"]  # local rotations; the hips' is their world rotation
    contacts: Float[Tensor, "batch frames 2"]  # contact logits of the left and the right toe
    log_spread: Float[Tensor, "batch frames joints 2"]  # of metres within which a joint lies with chances QUANTILES
    rough: "ProposedPoses | None" = None  # proposal of the first stage, of the second's

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
        self.detail = _Detail(config)

    def forward(self, motion: PartialMotion) -> ProposedPoses:
        """Propose poses for an interpolated motion."""
        shown = rotations.to_matrix(motion.quats)
        seen = motion.known.rotations.any(dim=-1) | motion.known.ground
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
        no_targets = local.new_zeros(*local.shape[:2], _TARGET_ROWS)
        positions = (local - self.mean_position) / self.std_position
        # Where the hips are and face, seen from the first frame.
        ground, facing = motion.root_position[..., ::2], motion.heading
        travelled = rotations.rotate_ground(ground - ground[:, :1], -facing[:, :1]) / _TRAVEL_UNIT
        turned = (facing - facing[:, :1])[..., None]
        return torch.cat(
            [
                *(each.flatten(-2) for each in (six, positions, step)),
                no_targets[..., 4:],
                turn,
                2 * motion.contacts - 1,
                known.rotations.float(),
                torch.stack([known.heading, known.ground, known.height, known.path], dim=-1).float(),
                no_targets[..., :4],
                *map(_encode_distance, (known.rotations.any(dim=-1), known.ground, torch.zeros_like(known.ground))),
                travelled,
                torch.sin(turned),
                torch.cos(turned),
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
        generated = rotations.from_six(six)
        known = motion.known.rotations
        others = torch.where(known[..., 1:, None, None], shown[..., 1:, :, :], generated[..., 1:, :, :])
        tilt, free, faced = generated[..., 0, :, :], ~known[..., 0], motion.known.heading
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
        self.near = nn.Conv1d(width, width, config.kernel, padding=config.kernel // 2, groups=width)

    def forward(
        self, tokens: Tensor, phases: tuple[Tensor, Tensor], seen: Bool[Tensor, "batch frames"] | None = None
    ) -> Tensor:
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


def _encode_distance(known: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames 6"]:
    """Encode frames since and until one was known, each on three scales."""
    far = count_frames_to_observed(known).nan_to_num(posinf=2 * _FAR_FRAMES)
    near = torch.exp(-far / _NEAR_FRAMES)
    return torch.cat([far.clamp(max=2 * _FAR_FRAMES) / _FAR_FRAMES, torch.log1p(far) / 3 - 0.7, near], dim=-1)


SOURCE = "transformer"
"""Name of the in-betweener in notes."""
MAX_GAP_FRAMES = 240
"""Frames of the longest gap that it fills; longer ones it leaves interpolated, with a note. Windows of training have up
to 200 frames; beyond 240 the hips stray farther than a tweener's."""
_CONTEXT = 24  # frames on either side of what is unknown that the network sees
_MAX_WINDOW, _OVERLAP = 240, 60  # frames of the longest window that no gap asks for, and that two windows share
_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False, repr=False)
class PoseTransformer(checkpoints.NetworkModel[PoseTransformerNetwork], Inbetweener):
    """A trained pose transformer."""

    kind, parts = "pose-transformer", (PoseTransformerNetwork, PoseTransformerConfig)

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the mean of the outputs for the query and for its mirror image, without sampling.

        Gaps of more than MAX_GAP_FRAMES in which nothing is known stay interpolated.
        """
        # Far from the world's origin single precision is coarse.
        known = (~query.missing.root).nonzero()[:, 0]
        origin = query.motion.root_position[known[0] if len(known) else 0].clone()
        origin[1] = 0.0
        near = replace(query, motion=replace(query.motion, root_position=query.motion.root_position - origin))
        motion = self._show(near)
        gaps = _find_silent_gaps(query)
        longest = max((stop - start for start, stop in gaps if stop - start <= MAX_GAP_FRAMES), default=0)
        poses = _average_mirrored(self._propose_windows(motion.with_mirror_image(), longest))
        root = poses.root_position[0].double() * query.scale + origin
        quats = rotations.from_matrix(poses.local_matrix[0].double())
        shown, missing = query.motion, query.missing
        too_long = torch.zeros_like(missing.root)
        for start, stop in gaps:
            too_long[start:stop] = stop - start > MAX_GAP_FRAMES
        # What is known keeps the query's own numbers.
        root = torch.where((missing.root & ~too_long)[:, None], root, shown.root_position)
        turned = missing.joints & ~too_long[:, None]
        quats = torch.where(turned[..., None], quats, shown.local_quat_xyzw)
        quats = blend_seams_in_rotations(quats, turned, fps=PRIOR_FPS)
        root = blend_seams_in_positions(root, missing.root & ~too_long, fps=PRIOR_FPS)
        logits = torch.where(
            motion.known.positions[0][:, list(TOE_JOINTS)],
            contacts.to_logits(motion.contacts[0] > 0.5),
            poses.contacts[0],
        )
        reason = f"longer than the {MAX_GAP_FRAMES / PRIOR_FPS:.0f} s that the {SOURCE} fills"
        others = tuple(
            GapSource(start, stop, INTERPOLATION, reason) for _, start, stop in true_intervals(too_long[:, None])
        )
        spread = poses.log_spread[0].exp() * query.scale
        return Proposal(replace(shown, root_position=root, local_quat_xyzw=quats), logits, SOURCE, others, spread)

    def _show(self, query: GapQuery) -> PartialMotion:
        """Return the query as the network takes it, of unit size, and interpolated anew as in its training."""
        body, missing = query.motion, query.missing
        heading, tilt = rotations.split_heading(body.local_quat_xyzw[:, 0])
        quats = torch.cat([tilt[:, None], body.local_quat_xyzw[:, 1:]], dim=1)
        nowhere = torch.zeros_like(missing.root)
        known = KnownParts(
            ~missing.joints[None],
            ~missing.joints[None, :, 0],
            ~missing.root[None],
            ~missing.root[None],
            (missing.root if query.keep_trajectory else nowhere)[None],
        )
        toes = body.joint_positions()[:, list(TOE_JOINTS)] / query.scale
        planted = torch.where(
            known.positions[0][:, list(TOE_JOINTS)], contacts.detect_contacts(toes, PRIOR_FPS).float(), 0.5
        )
        motion = PartialMotion(
            (body.root_position / query.scale).float()[None],
            rotations.unwrap_angle(heading).float()[None],
            quats.float()[None],
            planted[None],
            (body.skeleton.offsets / query.scale).float()[None],
            known,
        )
        return self.network.interpolate(motion)

    def _propose_windows(self, motion: PartialMotion, longest: int) -> ProposedPoses:
        """Propose window by window, with room for the longest gap; where two overlap, one fades into the other."""
        frames = motion.heading.shape[1]
        logits = contacts.to_logits(motion.contacts > 0.5)
        spread = motion.root_position.new_full((*motion.heading.shape, _JOINTS, 2), -9.0)
        joined = _pack(ProposedPoses(motion.root_position, motion.local_matrices(), logits, spread))
        weights = torch.zeros(frames)
        for first, stop in _lay_windows(~motion.known.everything[0], max(_MAX_WINDOW, longest + 2 * _CONTEXT)):
            rows = _pack(self.network(motion.slice(first, stop)))
            shared, fade = int(weights[first:stop].sum()), torch.ones(stop - first)
            if shared > 1:  # rising where another window has been before
                fade[:shared] = torch.linspace(0, 1, shared)
            joined[:, first:stop] = torch.lerp(joined[:, first:stop], rows, fade[:, None])
            weights[first:stop] = 1.0
        return _unpack(joined)


def _lay_windows(unknown: Bool[Tensor, " frames"], longest: int) -> Iterator[tuple[int, int]]:
    """Yield first frame and one past the last of windows around what is unknown, none longer than the longest."""
    frames = len(unknown)
    near = unknown.clone()
    for _, start, stop in true_intervals(unknown[:, None]):
        near[max(0, start - _CONTEXT // 2) : stop + _CONTEXT // 2] = True
    for _, start, stop in true_intervals(near[:, None]):
        first, stop = max(0, start - _CONTEXT // 2), min(frames, stop + _CONTEXT // 2)
        while stop - first > longest:
            yield first, first + longest
            first += longest - _OVERLAP
        yield first, stop


def _find_silent_gaps(query: GapQuery) -> list[tuple[int, int]]:
    """Return first frames and one past the last of gaps in which nothing is given."""
    silent = query.nothing_known
    if query.keep_trajectory:
        silent = silent & ~query.missing.root
    return [(start, stop) for _, start, stop in true_intervals(silent[:, None])]


def _pack(poses: ProposedPoses) -> Float[Tensor, "batch frames rows"]:
    parts = (
        poses.root_position,
        rotations.to_six(poses.local_matrix).flatten(-2),
        poses.contacts,
        poses.log_spread.flatten(-2),
    )
    return torch.cat(parts, dim=-1)


def _unpack(rows: Float[Tensor, "batch frames rows"]) -> ProposedPoses:
    joints = CANONICAL.num_joints
    root, six, logits, spread = rows.split([3, 6 * joints, 2, 2 * joints], dim=-1)
    return ProposedPoses(
        root, rotations.from_six(six.unflatten(-1, (joints, 6))), logits, spread.unflatten(-1, (joints, 2))
    )


def _average_mirrored(poses: ProposedPoses) -> ProposedPoses:
    """Return the mean of the first of two proposals and the mirror image of the second."""
    root, local, logits, spread = poses.root_position, poses.local_matrix, poses.contacts, poses.log_spread
    flip = root.new_tensor([-1.0, 1.0, 1.0])
    back = local[1:, ..., _PARTNERS, :, :] * flip[:, None] * flip
    return ProposedPoses(
        (root[:1] + root[1:] * flip) / 2,
        rotations.from_six((rotations.to_six(local[:1]) + rotations.to_six(back)) / 2),
        (logits[:1] + logits[1:].flip(-1)) / 2,
        (spread[:1] + spread[1:, ..., _PARTNERS, :]) / 2,
    )
