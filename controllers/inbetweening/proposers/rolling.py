"""Rollouts within a motion: the committed frames before one, and its insertion into a gap or beyond the end."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.motion import Motion
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.pose import decode
from mapctl.problem import density_selection
from mapctl.problem.receding_horizon import CommittedFrames, replay
from mapctl.problem.window_solvers import SolvedWindow
from mapctl.protocols import Density, DensityState
from mapctl.skeleton import CANONICAL

_PAST_FRAMES = 3  # frames before a gap that terms look back on


def select_likeliest_density(densities: Sequence[Density], motion: Motion) -> Density:
    """Select the density under which a canonical motion, with a proposal's observation noise, is likeliest."""
    if len(densities) == 1:
        return densities[0]
    blurred = [density.with_observation_noise(density_selection.proposal_sigma()) for density in densities]
    return densities[blurred.index(density_selection.select_density_for_motion(blurred, motion).density)]


def commit_before(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    start: int,
    density: Density,
    state: DensityState | None = None,
    *,
    since: int = 0,
) -> CommittedFrames:
    """Commit a motion's frames before a gap, with their contacts, single precision; a density's `state` is advanced
    from frame `since` on.
    """
    features, before = encode(body.slice(0, max(2, start)))
    ground, heading = integrate_root(features, before)
    features[:, LAYOUT.slices["contacts"]] = (contact_logits[: len(features)] > 0).to(features)
    features = features[:start].float()
    ground_pose = GroundPose(ground[start - 1].float(), heading[start - 1].float())
    past = body.slice(max(0, start - _PAST_FRAMES), start).joint_positions().float()
    advanced = state if state is not None and since >= start else replay(density, features, state, since=since)
    return CommittedFrames(advanced, ground_pose, features, past)


def insert_rollout(
    body: Motion,
    contact_logits: Float[Tensor, "frames 2"],
    window: SolvedWindow,
    ground_pose: GroundPose,
    gap: tuple[int, int],
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """Insert a rollout in its gap, corrected so that it arrives at the frame after it, if there is one; also return the
    contact logits.
    """
    start, stop = gap
    made = decode(window.trial.features[0], GroundPose(ground_pose.position_xz.double(), ground_pose.heading.double()))
    count, planted = stop - start, window.trial.contacts[0]
    root, quats, logits = body.root_position.clone(), body.local_quat_xyzw.clone(), contact_logits.clone()
    root[start:stop], quats[start:stop] = made.root_position[:count], made.local_quat_xyzw[:count]
    if count < len(made.root_position):
        there, here = body.slice(stop, stop + 1), made.slice(count, count + 1)
        root[start:stop], quats[start:stop] = _arrive(here, there, root[start:stop], quats[start:stop])
    new = torch.zeros(len(root), dtype=torch.bool)
    new[start:stop] = True
    root = blend_seams_in_positions(root, new, fps=PRIOR_FPS)
    quats = blend_seams_in_rotations(quats, new[:, None].expand(-1, CANONICAL.num_joints), fps=PRIOR_FPS)
    logits[start:stop] = contacts.to_logits(planted[:count]).to(logits)
    return replace(body, root_position=root, local_quat_xyzw=quats), logits


def _arrive(
    here: Motion, there: Motion, root: Float[Tensor, "frames 3"], quats: Float[Tensor, "frames joints 4"]
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 4"]]:
    """Spread what a rollout arrives `here` instead of `there` over all its frames: none of it in the two frames before,
    all of it in two after, so that it leaves and arrives at its own pace."""
    turn = rotations.to_rotation_vector(
        rotations.multiply(rotations.inverse(here.local_quat_xyzw), there.local_quat_xyzw)
    )
    firm = torch.ones(len(root) + 4, dtype=torch.bool)
    firm[2:-2] = False
    miss = root.new_zeros(len(firm), 3 + 3 * quats.shape[1])
    miss[-2:] = torch.cat([there.root_position - here.root_position, turn.flatten(1)], dim=1)
    offsets = interpolate_offsets(miss, firm, seconds=math.inf, fps=PRIOR_FPS)[2:-2]
    turns = rotations.from_rotation_vector(offsets[:, 3:].unflatten(1, (-1, 3)))
    return root + offsets[:, :3], rotations.multiply(quats, turns)
