"""Where a limb's end goes on its way to a place: vectors from its first joint, turned and kept within its length."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import LIMBS

_DETOUR = 0.8  # share of the way out that a turn between opposite directions takes
_OWN_SIDE = 0.5  # of the way out that leads to a limb's own side, where 1 leads ahead


def find_out(name: str, joints: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames 3"]:
    """Find the unit vectors that lead level ahead of the shoulders, and somewhat to the own side of a hand or foot,
    from world positions of canonical joints."""
    left, right = (joints[:, LIMBS[side].upper] for side in ("leftHand", "rightHand"))
    across = torch.nn.functional.normalize((left - right) * joints.new_tensor([1.0, 0.0, 1.0]), dim=-1)
    ahead = torch.stack([-across[:, 2], torch.zeros_like(across[:, 0]), across[:, 0]], dim=-1)
    side = _OWN_SIDE if name.startswith("left") else -_OWN_SIDE
    return torch.nn.functional.normalize(ahead + side * across, dim=-1)


def bend_within(
    away: Float[Tensor, "frames 3"], length: float, *, easy: float, most: float
) -> Float[Tensor, "frames 3"]:
    """Bring vectors, metres, smoothly to where a limb of some length reaches them without being stretched: a stretched
    elbow swings fast. From the share `easy` of the length on they are shortened, to the share `most` at last."""
    far = away.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    bent, soft = easy * length, (most - easy) * length
    near = torch.where(far > bent, bent + soft * (1 - torch.exp(-(far - bent).clamp_min(0) / soft)), far)
    return away / far * near


def lead_about(
    one: Float[Tensor, "frames 3"],
    other: Float[Tensor, "frames 3"],
    share: Float[Tensor, " frames"],
    *,
    out: Float[Tensor, "frames 3"],
) -> Float[Tensor, "frames 3"]:
    """Turn one vector toward another by a share, its length by the same share; by way of `out`, a unit vector that
    leads away from the body, the more the two differ: a straight turn from a hand at one's side to a place overhead has
    no direction of its own, and flips."""
    lengths = [vector.norm(dim=-1, keepdim=True).clamp_min(1e-6) for vector in (one, other)]
    begin, end = one / lengths[0], other / lengths[1]
    apart = (1 - (begin * end).sum(-1, keepdim=True)) / 2
    middle = torch.nn.functional.normalize(begin + end + 2 * _DETOUR * apart * out, dim=-1)
    share = share[:, None]
    turned = _turn_toward(_turn_toward(begin, middle, share), _turn_toward(middle, end, share), share)
    return turned * torch.lerp(lengths[0], lengths[1], share)


def _turn_toward(
    one: Float[Tensor, "frames 3"], other: Float[Tensor, "frames 3"], share: Float[Tensor, "frames 1"]
) -> Float[Tensor, "frames 3"]:
    """Turn unit vectors toward others by a share of the angle between them (Shoemake 1985)."""
    angle = torch.atan2(torch.linalg.cross(one, other).norm(dim=-1, keepdim=True), (one * other).sum(-1, keepdim=True))
    near = angle.clamp_min(1e-6)
    turned = (torch.sin((1 - share) * near) * one + torch.sin(share * near) * other) / torch.sin(near)
    return torch.nn.functional.normalize(torch.where(angle > 1e-4, turned, torch.lerp(one, other, share)), dim=-1)
