"""What an infiller proposes for a gap, as a motion of rigid bones: its places without their tremble, by inverse
kinematics, with closed seams.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.geometry.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.kinematics import heading, inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, LIMBS, TOE_JOINTS, Limb

_JITTER_SIGMA, _POWER_SIGMA = 0.8, 10  # frames at the prior's rate
_MIN_CHANGE = 0.005  # metres
_SWAY_SIGMA, _DRIFT_PASSES = 10, 4  # frames at the prior's rate: slower than a step
_KNOWN_CONTACT_LOGIT = 4.0  # log odds of contacts that are known
_MIN_SWING_SPEED = (
    0.5  # m/s from which a proposed toe swings, whatever the odds that it stands: held, it would jerk the leg
)


def propose_motion(
    gap: CanonicalGap, infiller: Inbetweener, targets: EffectorTargets | None, *, held: bool
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """The infiller's motion on rigid bones, its seams closed, and the log odds of its contacts; `held` to its guess of
    where the hips go, but for their sway.
    """
    shown = gap.motion
    body = Motion(CANONICAL, shown.fps, shown.root_position / gap.scale, shown.local_quat_xyzw)
    places, known = body.joint_positions(), gap.compute_known_positions()
    if targets is not None:
        places = torch.where(targets.wanted[..., None], targets.places / gap.scale, places)
        known = known | targets.wanted
    stands = contacts.detect_contacts(places[:, list(TOE_JOINTS)], PRIOR_FPS).float()
    image = PositionImage.of_world(
        places.float()[None],
        heading(shown.local_quat_xyzw[:, 0]).float()[None],
        stands[None],
        known=known[None],
        present=torch.ones(1, len(places), dtype=torch.bool),
        toes=TOE_JOINTS,
    )
    answer = infiller.propose(image)
    wanted = image.to_world(_remove_jitter(answer.places, image))[0].double()
    if held:
        wanted = wanted - _estimate_root_drift(wanted[:, 0] - body.root_position, gap.root)[:, None]
    root = torch.where(gap.root[:, None], wanted[:, 0], body.root_position)
    quats = inverse.solve_inverse_kinematics(
        wanted, shown.local_quat_xyzw, CANONICAL, free=gap.turns, root_position=root, limbs=_select_limbs(gap.turns)
    )
    quats = torch.where(gap.turns[..., None], quats, shown.local_quat_xyzw)
    quats = blend_seams_in_rotations(quats, gap.turns, fps=PRIOR_FPS)
    root = blend_seams_in_positions(root * gap.scale, gap.root, fps=PRIOR_FPS)
    made = replace(shown, root_position=root, local_quat_xyzw=quats)
    bits = torch.where(
        _compute_toe_speeds(made) < _MIN_SWING_SPEED * gap.scale, answer.contacts[0], -_KNOWN_CONTACT_LOGIT
    )
    return made, torch.where(image.known[0][:, list(TOE_JOINTS)], _KNOWN_CONTACT_LOGIT * (2 * stands - 1), bits)


def _select_limbs(lost: Bool[Tensor, "frames joints"]) -> list[Limb]:
    """Arms and legs; how those bend that are known in no frame nothing tells but the proposal."""
    return [
        replace(limb, shown=not bool(lost[:, [limb.upper, limb.lower]].any(dim=1).all())) for limb in LIMBS.values()
    ]


def _remove_jitter(places: Float[Tensor, "1 frames joints 3"], image: PositionImage) -> Tensor:
    """A network's frames are each a little off on their own: what it changes is smoothed over about a frame. Where it
    changes next to nothing it only fidgets, and the guess is as good. What it leaves alone stays.
    """
    change = (places - image.places)[0]
    smooth = gaussian.convolve(change, gaussian.kernel(_JITTER_SIGMA, 3), "repeated")
    power = gaussian.convolve(smooth.square().sum(dim=-1), gaussian.kernel(_POWER_SIGMA, 3 * _POWER_SIGMA), "repeated")
    smooth = smooth * (power / (power + _MIN_CHANGE**2))[..., None]
    return torch.where(image.known[..., None], places, image.places + smooth)


def _estimate_root_drift(off: Float[Tensor, "frames 3"], lost: Bool[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
    """What hips stray by over the ground, without their sway; nothing where they are known."""
    off = torch.where(lost[:, None], off, 0.0) * torch.tensor([1.0, 0.0, 1.0], dtype=off.dtype)
    slow, taps = torch.zeros_like(off), gaussian.kernel(_SWAY_SIGMA, 4 * _SWAY_SIGMA)
    for _ in range(_DRIFT_PASSES):  # each takes the slow part of what the ones before it left
        slow = slow + torch.where(lost[:, None], gaussian.convolve(off - slow, taps, "repeated"), 0.0)
    return slow


def _compute_toe_speeds(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Over the ground, m/s."""
    toes = motion.joint_positions()[:, list(TOE_JOINTS)][..., ::2]
    return torch.diff(toes, dim=0, prepend=toes[:1]).norm(dim=-1) * float(motion.fps)
