"""What stays known of training windows: gaps between runs of poses, what is told in them, lost joints, and keys."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.inbetweening.partial_motion import EFFECTORS, KnownParts, PartialMotion
from mapctl.numerics import gaussian
from mapctl.skeleton import CANONICAL
from priors.training.augmentation.draws import Draws

_JOINTS = CANONICAL.num_joints
_TRUNK = CANONICAL.indices(("spine", "chest", "neck", "head"))


@dataclass(frozen=True)
class PartSettings:
    """What stays known. A window has gaps, lost joints, or keys; shares of the three are these, gaps get the rest."""

    joints: float = 0.22
    """Share of windows that lose joints."""
    keys: float = 0.08
    """Share of windows of which only single frames are known, now and then."""
    several: float = 0.25
    """Share of windows with gaps that have several."""
    bare: float = 0.4
    """Share of runs of known frames that are one frame long."""
    context: int = 16
    """Frames of the longest run beside a gap."""
    open: float = 0.08
    """Share of windows with gaps that end, or half as often begin, in one."""
    parts: float = 0.33
    """Share of windows with gaps of which something is told in the gap."""
    reaching: float = 0.5
    """Share of windows that lose joints of which hands or feet that are lost are told where to be, now and then or for
    a while; half of them lose the trunk too."""


def sample_known_parts(motion: PartialMotion, settings: PartSettings, generator: torch.Generator) -> PartialMotion:
    """Return windows of which only a part is known; something is known in every window."""
    batch, frames = motion.heading.shape
    draw = Draws(generator, batch, frames)
    kind = draw.uniform()
    lossy, keyed = kind < settings.joints, kind > 1 - settings.keys
    poses = torch.where(keyed[:, None], _sample_keys(draw), _sample_gaps(draw, settings))
    poses = torch.where((lossy & (draw.uniform() < 0.8))[:, None], True, poses)
    known = KnownParts.whole(poses)
    lost = torch.where(lossy[:, None, None], _sample_lost_joints(draw), False)
    reaching = lossy & (draw.uniform() < settings.reaching)
    lost = lost | _lose_trunk(draw, lost, reaching & (draw.uniform() < 0.5))
    told = ~lossy & (draw.uniform() < settings.parts)
    motion, known = _tell_parts(draw, motion, known, told)
    known = replace(known, rotations=known.rotations & ~lost)
    effectors = reaching[:, None, None] & _sample_reached(draw, 0.5) & ~known.positions[..., list(EFFECTORS)]
    return replace(motion, known=replace(known, effectors=known.effectors | effectors))


def _sample_gaps(draw: Draws, settings: PartSettings) -> Bool[Tensor, "batch frames"]:
    """True where a pose is known: a run, a gap, a run, and so on; mostly one gap."""
    known = torch.zeros(draw.batch, draw.frames, dtype=torch.bool)
    numbers = draw.uniform(4).tolist()
    many = torch.rand(draw.batch, 40, generator=draw.generator).tolist()
    for row, (several, begin, end, scale) in enumerate(numbers):
        values = iter(many[row])

        def run(values=values) -> int:
            if next(values) < settings.bare:
                return 1
            return 1 + math.ceil(next(values) * (settings.context - 1))

        mask = [False] * draw.frames
        before = 0 if begin < settings.open / 2 else min(run(), draw.frames - 2)
        after = 0 if end < settings.open and before else min(run(), draw.frames - before - 1)
        mask[:before] = [True] * before
        mask[draw.frames - after :] = [True] * after
        if several < settings.several:
            mean, at = 3 * (draw.frames / 6) ** scale, before
            for _ in range(8):
                at += max(1, round(mean * (0.3 + 1.4 * next(values))))
                length = run()
                if at + length >= draw.frames - after:
                    break
                mask[at : at + length] = [True] * length
                at += length
        known[row] = torch.tensor(mask)
    return known


def _sample_keys(draw: Draws) -> Bool[Tensor, "batch frames"]:
    """Single frames here and there, the first one among them."""
    known = draw.uniform(draw.frames) < 1 / (2 + draw.uniform(1) * 60)
    known[:, 0] = True
    return known


def _sample_stretch(draw: Draws, shortest: float) -> Bool[Tensor, "batch frames"]:
    length = shortest + draw.uniform() * (draw.frames - shortest)
    return draw.mark(draw.uniform() * (draw.frames + 8 - length).clamp_min(1) - 4, length)


def _sample_lost_joints(draw: Draws) -> Bool[Tensor, "batch frames joints"]:
    """1 to 3 joints, or one or two limbs, throughout or for a stretch; or any joint now and then."""
    joints = draw.joints(limbs=0.65)
    joints = joints | (draw.limb() & (draw.uniform(1) < 0.3))
    during = _sample_stretch(draw, 6) | (draw.uniform(1) < 0.7)
    dropped = draw.uniform(draw.frames, _JOINTS) < 0.5 * draw.uniform(1, 1)
    return torch.where((draw.uniform() < 0.15)[:, None, None], dropped, joints[:, None] & during[..., None])


def _lose_trunk(
    draw: Draws, lost: Bool[Tensor, "batch frames joints"], chosen: Bool[Tensor, " batch"]
) -> Bool[Tensor, "batch frames joints"]:
    """Spine to head of chosen windows in the frames that lack any joint: who reaches far leans and turns."""
    trunk = torch.zeros(_JOINTS, dtype=torch.bool)
    trunk[list(_TRUNK)] = True
    return chosen[:, None, None] & lost.any(dim=-1, keepdim=True) & trunk


def _sample_reached(draw: Draws, held: float) -> Bool[Tensor, "batch frames 1"]:
    """Frames in which places of hands and feet are told: one here and there, or, in a share of windows, a while."""
    reached = draw.uniform(draw.frames, 1) < draw.uniform(1, 1) ** 2 * 0.12
    stretch = draw.mark(draw.uniform() * draw.frames, 1 + draw.uniform() * 12)[..., None]
    return torch.where((draw.uniform() < held)[:, None, None], stretch, reached)


def _tell_parts(
    draw: Draws, motion: PartialMotion, known: KnownParts, told: Bool[Tensor, " batch"]
) -> tuple[PartialMotion, KnownParts]:
    """Tell something in gaps: some joints, the hips throughout, roughly, or at single frames, hands and feet."""
    which = torch.where(told, draw.uniform(), 2.0)

    def chosen(low: float, high: float) -> Bool[Tensor, "batch 1"]:
        return ((which >= low) & (which < high))[:, None]

    joints = draw.joints(limbs=0.65)
    joints = torch.where(draw.uniform(1) < 0.4, ~joints, joints)
    stretch = _sample_stretch(draw, 1)
    rotations = known.rotations | (chosen(0.0, 0.2)[..., None] & joints[:, None] & stretch[..., None])
    # With joints often, else alone: where the hips go and face, as far as it is told.
    throughout = (chosen(0.0, 0.2) & (draw.uniform(1) < 0.6)) | chosen(0.2, 0.35)
    single = chosen(0.5, 0.72) & (draw.uniform(draw.frames) < draw.uniform(1) ** 2 * 0.15)
    hips = (throughout & stretch) | single
    heading = known.heading | (hips & (draw.uniform(1) < 0.7))
    rotations[..., 0] |= hips & heading & (draw.uniform(1) < 0.6)
    ground, height = (each | (hips & (draw.uniform(1) < 0.85)) for each in (known.ground, known.height))
    path = chosen(0.35, 0.5) & ~ground
    which_effectors = draw.uniform(1, len(EFFECTORS)) < 0.2 + 0.4 * draw.uniform(1, 1)
    effectors = (
        chosen(0.64, 1.01)[..., None]
        & _sample_reached(draw, 0.2)
        & which_effectors
        & ~known.positions[..., list(EFFECTORS)]
    )
    parts = KnownParts(rotations, heading, ground, height, path, effectors)
    return replace(motion, root_position=_roughen(draw, motion.root_position, path)), parts


def _roughen(draw: Draws, root: Float[Tensor, "batch frames 3"], path: Bool[Tensor, "batch frames"]) -> Tensor:
    """Smooth paths on the ground, and lead half of them a little astray."""
    if not bool(path.any()):
        return root
    rows = path.any(dim=1)
    ground = root[rows][..., ::2]
    smooth = gaussian.convolve(ground.transpose(0, 1), gaussian.kernel(8.0, 24), "repeated").transpose(0, 1)
    knots = 0.06 * draw.normal(2, 6)[rows] * (draw.uniform(1, 1)[rows] < 0.5)
    astray = torch.nn.functional.interpolate(knots, size=root.shape[1], mode="linear", align_corners=True)
    smooth = smooth + astray.transpose(1, 2)
    rough = root.clone()
    rough[rows] = torch.stack([smooth[..., 0], root[rows][..., 1], smooth[..., 1]], dim=-1)
    return torch.where(path[..., None], rough, root)
