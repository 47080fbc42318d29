"""Clips of any performer on the canonical body, their feet on a level floor.

Features keep the hips' height and way of whoever was recorded, while priors are decoded on canonical bones. Of captures
whose floor slopes or whose feet rest at another height, as those of CMU, features would say that feet go through the
floor, and contacts be found where the floor is lowest alone.
"""

from dataclasses import replace
from functools import cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import estimate_floor_heights
from mapctl.motion import Motion
from mapctl.retarget import RigMap, identify_rig
from mapctl.retarget.carry import RiggedCharacter, retarget_canonical
from mapctl.retarget.stance import Stance
from mapctl.skeleton import CANONICAL, TOE_JOINTS

STEEPEST = 0.05
"""Largest slope that is taken for a fault of the capture, metres a metre."""
_STILL = 0.25  # m/s of a toe that stands
_ROUGH = 0.015  # metres rms of standing toes about the plane, beyond which they stand on stairs or things
_FEW = 12  # standing toes that tell a plane
_NEAR = 0.01  # metres; what is further from the plane counts less
_USUAL = 0.02  # slope, metres a metre: across a straight walk nothing tells it, and it shall be none


def stand_on_canonical(motion: Motion, rigmap: RigMap) -> Motion:
    """Return a motion on canonical joints (from `to_canonical` with this map) on the canonical bones and a level floor.

    What slopes is turned level as a whole, and each toe then rests as high as the canonical one; hips and steps are in
    the scale of the legs (see `mapctl.retarget.carry`).
    """
    leveled = _put_on_floor(turn_level(motion, find_floor_slope(motion)))
    giver = RiggedCharacter(rigmap, Stance.of(leveled, rigmap))
    return retarget_canonical(leveled, giver, _canonical_body()).motion


def find_floor_slope(motion: Motion) -> Float[Tensor, "2"]:
    """Find by how much the floor rises along x and z, metres a metre, from where toes stand in a canonical motion.

    A plane for each toe, of one slope, is fitted with weights that fall with the distance from it. Zero where too few
    toes stand, where they stand on no plane, or on one steeper than STEEPEST.
    """
    toes = motion.joint_positions()[:, list(TOE_JOINTS)]
    still = torch.diff(toes, dim=0).norm(dim=-1) * float(motion.fps) < _STILL
    none = torch.zeros(2, dtype=torch.float64)
    if int(still.sum()) < _FEW:
        return none
    places, which = toes[1:][still], still.nonzero()[:, 1]
    slope, rough = _fit_plane(places, which == 0)
    return slope if rough < _ROUGH and float(slope.norm()) < STEEPEST else none


def _fit_plane(places: Float[Tensor, "points 3"], left: Bool[Tensor, " points"]) -> tuple[Float[Tensor, "2"], float]:
    """Slope along x and z, and the weighted rms distance from the plane, metres."""
    ground, height = places[:, ::2] - places[:, ::2].mean(dim=0), places[:, 1]
    known = torch.cat([left[:, None], ~left[:, None], ground], dim=1).double()
    usual = torch.diag(torch.tensor([1e-9, 1e-9, 1.0, 1.0], dtype=torch.float64)) * (_NEAR / _USUAL) ** 2
    weight = torch.ones_like(height)
    found, off = torch.zeros(known.shape[1]).double(), height
    for _ in range(10):
        weighted = known * weight[:, None]
        found = torch.linalg.solve(known.T @ weighted + usual, weighted.T @ height)
        off = height - known @ found
        weight = 1 / (1 + (off / _NEAR).square())
    return found[2:], float((weight * off.square()).sum().div(weight.sum()).sqrt())


def turn_level(motion: Motion, slope: Float[Tensor, "2"]) -> Motion:
    """Turn the whole motion so that a floor with this slope (metres a metre along x and z) is level; headings stay."""
    size = float(slope.norm())
    if size == 0:
        return motion
    # About the line in the floor that is level: what points up the slope goes down.
    axis = torch.tensor([-float(slope[1]), 0.0, float(slope[0])], dtype=torch.float64) / size
    turn = rotations.from_rotation_vector(-torch.atan(slope.norm()) * axis).expand(motion.num_frames, 4)
    middle = motion.root_position.mean(dim=0)
    middle[1] = 0
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(turn, local[:, 0])
    root = rotations.rotate(turn, motion.root_position - middle) + middle
    return replace(motion, root_position=root, local_quat_xyzw=local)


def _put_on_floor(motion: Motion) -> Motion:
    """Shift up or down until toes rest about as high as they should: what is far off counts as a platform else."""
    seen = estimate_floor_heights(motion.joint_positions()[:, list(TOE_JOINTS)])
    root = motion.root_position.clone()
    root[:, 1] -= (seen - Stance.at_rest(motion.skeleton).toe_height).min()
    return replace(motion, root_position=root)


@cache
def _canonical_body() -> RiggedCharacter:
    return RiggedCharacter(identify_rig(CANONICAL), Stance.at_rest(CANONICAL))
