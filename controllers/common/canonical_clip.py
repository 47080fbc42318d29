"""A clip on any rig as a canonical one: resampled with its mask to a query at 30 fps, and the answer put on its rig."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.loose_keys import LooseKeys
from mapctl.inbetweening.missing import MissingMask, interpolate_missing, restore_observed
from mapctl.inbetweening.query import GapQuery
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.motion import Motion
from mapctl.recording.fusion import transfer_change
from mapctl.retarget import RigMap, from_canonical, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

_TIE_FRAMES = 1e-6  # frames


@dataclass(frozen=True, eq=False)
class CanonicalClip:
    """A clip with missing values, on its own rig and on canonical joints."""

    original: Motion
    """The clip as given; its missing values may be anything."""
    missing: MissingMask
    """Missing values, by joint of the rig."""
    interpolated: Motion
    """The clip with its missing values interpolated."""
    canonical: Motion
    """The interpolated clip on canonical joints and the performer's bones, at its own rate."""
    rigmap: RigMap
    """Map from the rig to canonical joints."""

    @staticmethod
    def of(motion: Motion, missing: MissingMask, rig: Rig | None = None) -> "CanonicalClip":
        """Make a clip canonical; `rig` overrides recognition. RequestError for a rig that is not recognised."""
        interpolated = interpolate_missing(motion, missing)
        return CanonicalClip(motion, missing, interpolated, *to_canonical(interpolated, rig))

    def query(
        self,
        *,
        effector_targets: EffectorTargets | None = None,
        keep_trajectory: bool = False,
        loose: LooseKeys | None = None,
    ) -> GapQuery:
        """Build the query for in-betweeners, at PRIOR_FPS; targets and loose keys are by frame of the clip.

        A frame of the query between two of the clip is the nearby frame with the fewest missing values, if that has
        fewer than the two.
        """
        canonical, missing = self.canonical, self.missing
        whole = _resample_to_end(canonical)
        at = torch.arange(whole.num_frames, dtype=torch.float64) * float(canonical.fps) / PRIOR_FPS
        at = at.clamp(max=canonical.num_frames - 1)
        low = (at + 1e-9).floor().long()
        high = torch.where(at - low > _TIE_FRAMES, low + 1, low).clamp(max=canonical.num_frames - 1)
        missing_values = torch.cat([missing.joints, missing.root[:, None]], dim=1)
        best = _find_most_complete_frames(at, missing_values.sum(dim=1))
        snapped = missing_values[best].sum(dim=1) < (missing_values[low] | missing_values[high]).sum(dim=1)
        at = torch.where(snapped, best.to(at), at)
        low, high = torch.where(snapped, best, low), torch.where(snapped, best, high)
        quats = torch.where(snapped[:, None, None], canonical.local_quat_xyzw[best], whole.local_quat_xyzw)
        root = torch.where(snapped[:, None], canonical.root_position[best], whole.root_position)
        shown = replace(whole, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))
        joints, seconds = self._missing_canonical_joints(), at / float(canonical.fps)
        if effector_targets is not None:
            effector_targets = effector_targets.shown(seconds, fps=float(canonical.fps))
        if loose is not None:
            loose = loose.shown(seconds, fps=float(canonical.fps))
        mask = MissingMask(joints[low] | joints[high], missing.root[low] | missing.root[high])
        return GapQuery(shown, mask, seconds, effector_targets, keep_trajectory, loose)

    def back(self, made: Motion, query: GapQuery) -> Motion:
        """Return an answer to the query on the rig, at the clip's rate, with blended seams and what is known to the
        bit. If the answer is the query's own interpolation, return the interpolation on the rig.
        """
        filled = self.interpolated
        if made is not query.motion or query.keep_trajectory or query.loose is not None:
            at_prior_rate = self.canonical.fps == PRIOR_FPS
            own = made if at_prior_rate else transfer_change(self.canonical, query.motion, made, query.seconds)
            filled = from_canonical(own, self.rigmap, self.interpolated)
            filled = self._blend_seams(restore_observed(filled, self.interpolated, self.missing))
        return self.restore_observed(filled)

    def restore_observed(self, motion: Motion) -> Motion:
        """Return the original with its missing values from a motion on its rig."""
        return restore_observed(motion, self.original, self.missing)

    def _missing_canonical_joints(self) -> Bool[Tensor, "frames joints"]:
        """Find the canonical joints whose rotation is missing; an End Site rotates with its parent."""
        columns = []
        for joint, own in enumerate(self.rigmap.joint_of):
            columns.append(columns[CANONICAL.parents[joint]] if own is None else self.missing.joints[:, own])
        return torch.stack(columns, dim=1)

    def _blend_seams(self, filled: Motion) -> Motion:
        fps, missing = float(self.original.fps), self.missing
        moving = {
            joint: blend_seams_in_positions(values, missing.root, fps=fps)
            for joint, values in filled.moving_offsets.items()
        }
        return replace(
            filled,
            moving_offsets=moving,
            root_position=blend_seams_in_positions(filled.root_position, missing.root, fps=fps),
            local_quat_xyzw=blend_seams_in_rotations(filled.local_quat_xyzw, missing.joints, fps=fps),
        )


def _resample_to_end(canonical: Motion) -> Motion:
    """Resample to PRIOR_FPS; an end that is far from the last frame there gets a frame of its own."""
    last = canonical.num_frames - 1
    moments = int(last * PRIOR_FPS / canonical.fps) + 1
    over = last * PRIOR_FPS / canonical.fps - (moments - 1)
    if over <= Fraction(1, 2):
        return canonical.resample(PRIOR_FPS)
    frame = torch.arange(canonical.num_frames + math.ceil(canonical.fps / PRIOR_FPS)).clamp(max=last)
    held = replace(
        canonical, root_position=canonical.root_position[frame], local_quat_xyzw=canonical.local_quat_xyzw[frame]
    )
    return held.resample(PRIOR_FPS).slice(0, moments + 1)


def _find_most_complete_frames(
    at: Float[Tensor, " shown"], missing_counts: Int[Tensor, " frames"]
) -> Int[Tensor, " shown"]:
    """Find for each time, in frames of the clip, the frame with the fewest missing values of those nearer to it than to
    another time; the nearest of several; any other frame if there is none.
    """
    edges = (at[1:] + at[:-1]) / 2 + _TIE_FRAMES  # a frame midway between two times belongs to the earlier one
    beyond = at.new_full((1,), torch.inf)
    own, last = at.round().long(), len(missing_counts) - 1
    reach = math.ceil(float(torch.diff(at).max()) / 2) + 1 if len(at) > 1 else last
    frames = own[:, None] + torch.arange(-reach, reach + 1)
    near = (frames > torch.cat([-beyond, edges])[:, None]) & (frames <= torch.cat([edges, beyond])[:, None])
    inside = near & (frames >= 0) & (frames <= last)
    frames = frames.clamp(0, last)
    cost = missing_counts[frames] + (frames - at[:, None]).abs() / (2 * reach + 2)
    best = torch.where(inside, cost, torch.inf).argmin(dim=1, keepdim=True)
    return torch.where(inside.any(dim=1), frames.gather(1, best)[:, 0], missing_counts.argmax())
