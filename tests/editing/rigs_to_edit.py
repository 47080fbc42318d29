"""Rigs of all kinds with a walk on them, for edits that must work on any rig."""

from dataclasses import replace

import torch
from helpers import walk
from rig_maker import Make, make, names_of

from mapctl.editing.rigged_motion import RiggedMotion, place_ankles
from mapctl.motion import Motion

RIGS = {
    "root on the ground": Make(names_of("bandai-namco"), root="joint_Root"),
    "fingers, twists, a sword": Make(names_of("mixamo")),
    "Z up": Make(names_of("vrm"), zup=True, arms_down_deg=40),
    "bones along x": Make(names_of("ue5"), bones_along_x=True, root="root"),
    "turned": Make(names_of("xsens"), turned_deg=90),
    "sides exchanged": Make(names_of("mixamo"), swapped=True, extras=False),
}


def on_rig(name: str, motion: Motion | None = None) -> Motion:
    """A walk, or another canonical motion, on a rig."""
    return make(RIGS[name]).motion(walk(75, cadence=1.0) if motion is None else motion)


def soft_knees(motion: Motion) -> Motion:
    """A canonical motion with its hips 2 cm lower over the same feet: no leg is quite straight."""
    ankles = RiggedMotion.of(motion).positions("Foot")
    lower = replace(motion, root_position=motion.root_position - torch.tensor([0.0, 0.02, 0.0]).double())
    return place_ankles(RiggedMotion.of(lower), ankles)


def longer_shin(motion: Motion, metres: float) -> Motion:
    """A canonical motion whose left shin is longer."""
    skeleton = motion.skeleton
    offsets = skeleton.offsets.clone()
    offsets[skeleton.index("leftFoot"), 1] -= metres
    return replace(motion, skeleton=replace(skeleton, offsets=offsets))


def toe_speed(motion: Motion, planted: torch.Tensor) -> float:
    """Largest speed over the ground of toes that stay planted from one frame to the next, m/s."""
    toes = RiggedMotion.of(motion).positions("Toes")
    speed = toes[..., ::2].diff(dim=0).norm(dim=-1) * float(motion.fps)
    return float(speed[planted[1:] & planted[:-1]].max())
