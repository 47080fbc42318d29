"""The pose in which a character stands: legs nearly straight, feet side by side, arms as in the prior's data."""

from dataclasses import replace

import torch

from mapctl import rotations
from mapctl.features import GroundPose
from mapctl.inbetweening.partial_motion import mirror_quats
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, TOES, Skeleton

_BEND_DEG = {"UpperLeg": -5.0, "LowerLeg": 10.0, "Foot": -5.0, "Toes": 0.0}
"""Bends of a leg that stands at ease, degrees about the lateral axis; the foot stays flat."""
_SPREAD_DEG = 3.0  # of each thigh sideways, undone at the foot


def build_rest_pose(density: Density, skeleton: Skeleton, toe_height: float) -> Motion:
    """Build one frame that stands at the origin and faces +Z, toes at `toe_height` metres.

    The trunk and the arms are the mean, over both sides, of the density's initial states: people who walk carry their
    arms much as they do when they stand.
    """
    states = decode(density.initial_states.state.last_frame, GroundPose.origin(), skeleton=skeleton)
    quats = states.local_quat_xyzw.double()
    mean = rotations.average(torch.cat([quats, mirror_quats(quats)]))
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        for part, bend in _BEND_DEG.items():
            spread = outwards * {"UpperLeg": _SPREAD_DEG, "Foot": -_SPREAD_DEG}.get(part, 0.0)
            angles = torch.deg2rad(torch.tensor([bend, 0.0, spread], dtype=torch.float64))
            mean[CANONICAL.index(side + part)] = rotations.from_rotation_vector(angles)
    mean[0] = mean.new_tensor([0.0, 0.0, 0.0, 1.0])
    pose = replace(states.slice(0, 1), root_position=torch.zeros(1, 3, dtype=torch.float64), local_quat_xyzw=mean[None])
    toes = pose.joint_positions()[0, list(skeleton.indices(TOES)), 1]
    return replace(pose, root_position=mean.new_tensor([[0.0, toe_height - float(toes.mean()), 0.0]]))
