"""The pose transformer as an in-betweener: from a query to a proposal on the character's bones, of any length."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.partial_motion import EFFECTORS, KnownParts, PartialMotion
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.numerics.intervals import true_intervals
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors import checkpoints
from priors.pose_transformer.network import PoseTransformerConfig, PoseTransformerNetwork, ProposedPoses

SOURCE = "transformer"
"""Name of the in-betweener in notes."""
MAX_GAP_FRAMES = 240
"""Frames of the longest gap that it fills; longer ones it leaves interpolated, and says so. Windows of training have up
to 200 frames; beyond 240 the hips stray farther than a tweener's."""
_CONTEXT = 24  # frames on either side of what is unknown that the network sees
_MAX_WINDOW, _OVERLAP = 240, 60  # frames of the longest window that no gap asks for, and that two windows share
_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False, repr=False)
class PoseTransformer(checkpoints.LoadedModel, Inbetweener):
    """A trained pose transformer."""

    name: str
    """Name under which it was loaded."""
    network: PoseTransformerNetwork
    """Network in evaluation mode."""
    card: checkpoints.Card
    """Card of the weights."""

    @property
    def takes_partial_keys(self) -> bool:
        """It is told places of hands, feet and hips in single frames."""
        return True

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the mean of the outputs for the query and for its mirror image, without sampling.

        Gaps of more than MAX_GAP_FRAMES in which nothing is known stay interpolated.
        """
        origin = _find_origin(query)
        motion = self._show(_move(query, -origin))
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
        targets, wanted = torch.zeros(len(quats), len(EFFECTORS), 3), nowhere[:, None].expand(-1, len(EFFECTORS))
        known = KnownParts(
            ~missing.joints[None],
            ~missing.joints[None, :, 0],
            ~missing.root[None],
            ~missing.root[None],
            (missing.root if query.keep_trajectory else nowhere)[None],
            wanted[None],
        )
        if query.effector_targets is not None:
            targets = (query.effector_targets.places[:, list(EFFECTORS)] / query.scale).float()
            wanted = query.effector_targets.wanted[:, list(EFFECTORS)][None] & ~known.positions[..., list(EFFECTORS)]
            known = replace(known, effectors=wanted)
        toes = body.joint_positions()[:, list(TOE_JOINTS)] / query.scale
        planted = torch.where(
            known.positions[0][:, list(TOE_JOINTS)], contacts.detect_contacts(toes, PRIOR_FPS).float(), 0.5
        )
        motion = PartialMotion(
            (body.root_position / query.scale).float()[None],
            rotations.unwrap_angle(heading).float()[None],
            quats.float()[None],
            planted[None],
            targets[None],
            (body.skeleton.offsets / query.scale).float()[None],
            known,
        )
        return self.network.interpolate(motion)

    def _propose_windows(self, motion: PartialMotion, longest: int) -> ProposedPoses:
        """Propose window by window, with room for the longest gap; where two overlap, one fades into the other."""
        frames = motion.heading.shape[1]
        joined, weights = _rows_of(motion), torch.zeros(frames)
        for first, stop in _lay_windows(~motion.known.everything[0], max(_MAX_WINDOW, longest + 2 * _CONTEXT)):
            rows = _pack(self.network(motion.slice(first, stop)))
            fade = _fade_in(first, weights, stop)
            joined[:, first:stop] = torch.lerp(joined[:, first:stop], rows, fade[:, None])
            weights[first:stop] = 1.0
        return _unpack(joined)


def _find_origin(query: GapQuery) -> Float[Tensor, " 3"]:
    """Return the hips' first known place on the ground: far from the world's origin single precision is coarse."""
    known = (~query.missing.root).nonzero()[:, 0]
    origin = query.motion.root_position[known[0] if len(known) else 0].clone()
    origin[1] = 0.0
    return origin


def _move(query: GapQuery, shift: Float[Tensor, " 3"]) -> GapQuery:
    """Return the query moved in the world."""
    moved = replace(query.motion, root_position=query.motion.root_position + shift)
    targets = query.effector_targets
    if targets is not None:
        targets = replace(targets, places=targets.places + shift)
    return replace(query, motion=moved, effector_targets=targets)


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


def _fade_in(first: int, weights: Float[Tensor, " frames"], stop: int) -> Float[Tensor, " window"]:
    """Return the share of a window by frame: rising where another one has been before."""
    shared = int(weights[first:stop].sum())
    fade = torch.ones(stop - first)
    if shared > 1:
        fade[:shared] = torch.linspace(0, 1, shared)
    return fade


def _find_silent_gaps(query: GapQuery) -> list[tuple[int, int]]:
    """Return first frames and one past the last of gaps in which nothing is told."""
    silent = query.nothing_known
    if query.effector_targets is not None:
        silent = silent & ~query.effector_targets.wanted.any(dim=1)
    if query.keep_trajectory:
        silent = silent & ~query.missing.root
    return [(start, stop) for _, start, stop in true_intervals(silent[:, None])]


def _rows_of(motion: PartialMotion) -> Float[Tensor, "batch frames rows"]:
    """Return rows as of a proposal that is the motion itself."""
    logits = contacts.to_logits(motion.contacts > 0.5)
    spread = motion.root_position.new_full((*motion.heading.shape, CANONICAL.num_joints, 2), -9.0)
    return _pack(ProposedPoses(motion.root_position, motion.local_matrices(), logits, spread))


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


def load(name: str = "transformer") -> PoseTransformer:
    """Load the bundled pose transformer, or a trained one by its file or run folder; CheckpointError for anything
    else.
    """
    with checkpoints.open_checkpoint(name, "pose-transformer") as (tensors, card):
        network = checkpoints.build_network(PoseTransformerNetwork, PoseTransformerConfig.of_card(card.config), tensors)
    return PoseTransformer(name, network, card)
