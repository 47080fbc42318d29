"""Corrupted copies of clean motion, as captures come: noise, spikes, joints and limbs that are lost, moments without
anything; and copies of clips at other tempos and with other strides, for corpora of a few minutes.

How much of each corruption is drawn anew for every window, and the network is given the noise as a file's would be
estimated. Features hold rotations and the trajectory of the hips, and priors are decoded on canonical bones: a body's
proportions show in them as how far and how high it steps alone. So a body with other legs is a motion whose feet go
further or less far over the same floor, and whose legs reach them.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.kinematics import chain_matrices
from mapctl.motion import Motion
from mapctl.pose import BodyPose
from mapctl.recording import Capture
from mapctl.retarget.carry import reach_ankle_targets
from mapctl.retarget.character import FEET, LEGS, TOES, limb_extension
from mapctl.retarget.legs import fit_hips, lower_hips
from mapctl.skeleton import CANONICAL
from priors.training.data import Corpus
from priors.training.windows import PoseWindows

LIMBS = tuple(
    tuple(CANONICAL.index(name) for name in names)
    for names in (
        ("leftShoulder", "leftUpperArm", "leftLowerArm", "leftHand"),
        ("leftUpperArm", "leftLowerArm", "leftHand"),
        ("rightShoulder", "rightUpperArm", "rightLowerArm", "rightHand"),
        ("rightUpperArm", "rightLowerArm", "rightHand"),
        ("leftLowerArm", "leftHand"),
        ("rightLowerArm", "rightHand"),
        ("leftUpperLeg", "leftLowerLeg", "leftFoot", "leftToes"),
        ("leftFoot", "leftToes"),
        ("rightUpperLeg", "rightLowerLeg", "rightFoot", "rightToes"),
        ("rightFoot", "rightToes"),
        ("neck", "head"),
        ("spine", "chest"),
    )
)
"""Joints that are lost together."""


class Draws:
    """Random numbers of one generator, for a batch of windows."""

    def __init__(self, generator: torch.Generator, batch: int, frames: int):
        self.generator, self.batch, self.frames = generator, batch, frames

    def uniform(self, *shape: int) -> Tensor:
        """(batch, *shape), from 0 to 1."""
        return torch.rand(self.batch, *shape, generator=self.generator)

    def normal(self, *shape: int) -> Tensor:
        """(batch, *shape), of unit variance."""
        return torch.randn(self.batch, *shape, generator=self.generator)

    def log_uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """(batch, *shape), their logarithms evenly between the bounds'."""
        return low * torch.exp(self.uniform(*shape) * math.log(high / low))

    def below(self, bound: Int[Tensor, " batch"]) -> Int[Tensor, " batch"]:
        """Whole numbers from 0 up to each bound, exclusive."""
        return (self.uniform() * bound).long().minimum(bound - 1)

    def limb(self) -> Bool[Tensor, "batch joints"]:
        """The joints of one of `LIMBS`."""
        limbs = torch.zeros(len(LIMBS), CANONICAL.num_joints, dtype=torch.bool)
        for row, joints in enumerate(LIMBS):
            limbs[row, list(joints)] = True
        return limbs[self.below(torch.full((self.batch,), len(LIMBS)))]

    def joints(self, limbs: float) -> Bool[Tensor, "batch joints"]:
        """1 to 3 joints at random, or in this share of cases those of a limb."""
        limb, order = self.limb(), self.uniform(CANONICAL.num_joints).argsort(dim=1).argsort(dim=1)
        some = order < (1 + self.uniform(1) * 3).floor()
        return torch.where(self.uniform(1) < 1 - limbs, some, limb)

    def stretch(self, length: Float[Tensor, " batch"]) -> Bool[Tensor, "batch frames"]:
        """One run of so many frames, that may reach beyond the window's ends."""
        return self.mark(self.uniform() * (self.frames + 8 - length).clamp_min(1) - 4, length)

    def mark(self, start: Tensor, length: Tensor) -> Bool[Tensor, "batch frames"]:
        """True from each start on for so many frames."""
        frame = torch.arange(self.frames)
        return (frame >= start[:, None]) & (frame < (start + length)[:, None])


_JOINTS = CANONICAL.num_joints


_ANGLE_DEG = (0.3, 10.0)  # noise of each of a joint's three angles, log-uniform
_ROOT_CM = (0.2, 6.0)  # noise of each coordinate of the hips, log-uniform
_CLEAN = 0.1  # share of windows whose angles, and share whose hips, have no noise
_UNEVEN = 0.5  # spread (of the logarithm) of the noise among joints, in half of the windows
_MARKERS = 0.25  # share of windows whose noise is that of joints' positions: bones point from one noisy one to the next
_MARKER_CM = (0.5, 6.0)  # noise of the joints' positions, log-uniform
_CORRELATED = 0.3  # share of windows whose noise is correlated in time, as that of a capture that was filtered before
_LASTING = 0.9  # largest share of such noise that comes from the frame before
_UNDERESTIMATED = 0.5  # share of these windows whose noise the network is given as estimated from frame to frame: less
_SPIKES = 0.02  # largest share of an angle's frames that are spikes, in half of the windows
_SPIKE_DEG = (15.0, 60.0)
_FOUND = 0.8  # share of the spikes that are found and masked
_DROPOUT = 0.4  # largest share of a joint's frames that are lost, in a third of the windows
_LIMB, _GAP = 0.25, 0.1  # shares of windows that lose a limb, and everything, for a while
_ESTIMATE_ERROR = 0.2  # error (of the logarithm) of the noise level that the network is given


def make_clean_capture(features: Float[Tensor, "batch frames size"]) -> Capture:
    """The features as a perfect capture, from the origin."""
    batch, frames = features.shape[:2]
    origin = GroundPose(features.new_zeros(batch, 2), features.new_zeros(batch))
    pose = BodyPose.of_features(features, origin)
    return Capture(
        pose.root_position,
        pose.local_quat_xyzw[..., 0, :],
        pose.joint_rotvec,
        torch.ones(batch, frames, dtype=torch.bool),
        torch.ones(batch, frames, _JOINTS, dtype=torch.bool),
        torch.zeros(batch),
        torch.zeros(batch, _JOINTS),
    )


def corrupt(clean: Capture, generator: torch.Generator) -> Capture:
    """Return a corrupted copy; what is masked keeps its values, which no network should see."""
    draw = Draws(generator, *clean.root.shape[:2])
    noise = _sample_noise(draw)
    spikes = _sample_spikes(draw)
    quats = torch.cat([clean.hips[:, :, None], rotations.from_rotation_vector(clean.joints)], dim=2)
    quats, root = _perturb_positions(quats, clean.root, noise, draw)
    angles = _correlate_in_time(draw.normal(draw.frames, _JOINTS, 3), noise.stays) * noise.angle[:, None, :, None]
    quats = rotations.multiply(quats, rotations.from_rotation_vector(_turn_axes(angles + spikes, draw)))
    root = root + draw.normal(draw.frames, 3) * noise.root[:, None, None]
    lost, nothing = _sample_missing(draw)
    found = (spikes != 0).any(dim=-1) & (draw.uniform(draw.frames, _JOINTS) < _FOUND)
    error = torch.exp(_ESTIMATE_ERROR * draw.normal(_JOINTS + 1))
    return Capture(
        root,
        quats[:, :, 0],
        rotations.to_rotation_vector(quats[:, :, 1:]),
        ~nothing,
        ~(lost | found | nothing[..., None]),
        noise.given_root * error[:, -1],
        noise.given_angle * error[:, :-1],
    )


@dataclass(frozen=True, eq=False)
class _Noise:
    """How noisy each window of a batch is."""

    angle: Float[Tensor, "batch joints"]  # sigma of each of a joint's angles, radians; 0 where positions are noisy
    root: Float[Tensor, " batch"]  # sigma of each coordinate of the hips, metres; 0 where positions are noisy
    position: Float[Tensor, " batch"]  # sigma of each coordinate of every joint, metres; 0 where angles are noisy
    stays: Float[Tensor, " batch"]  # share of the noise that comes from the frame before
    given_angle: Float[Tensor, "batch joints"]  # noise of angles that the network is given, radians
    given_root: Float[Tensor, " batch"]  # noise of the hips' position that the network is given, metres


_MAX_NOISE_RAD = 0.6  # radians of noise; more is no noise but another motion


_LENGTHS = CANONICAL.offsets.norm(dim=-1).float()
_BONES = torch.stack([_LENGTHS[next(iter(CANONICAL.children(joint)), joint)] for joint in range(_JOINTS)])
"""From each canonical joint to the next, metres; of the last ones, the bone before."""


def _sample_noise(draw: Draws) -> _Noise:
    """Draw the noise of angles and the hips, or that of all positions."""
    angle = torch.deg2rad(draw.log_uniform(*_ANGLE_DEG, 1)) * (draw.uniform(1) > _CLEAN)
    uneven = torch.where(draw.uniform(1) < 0.5, _UNEVEN, 0.0) * draw.normal(_JOINTS)
    root = draw.log_uniform(*_ROOT_CM) / 100 * (draw.uniform() > _CLEAN)
    marked = draw.uniform() < _MARKERS
    position = torch.where(marked, draw.log_uniform(*_MARKER_CM) / 100, 0.0)
    angle, root = torch.where(marked[:, None], 0.0, angle * torch.exp(uneven)), torch.where(marked, 0.0, root)
    stays = torch.where(draw.uniform() < _CORRELATED, _LASTING * draw.uniform(), 0.0)
    share = torch.where(draw.uniform() < _UNDERESTIMATED, _estimated_share(stays), 1.0)
    given_angle = torch.where(marked[:, None], _angles_of_positions(position), angle)
    return _Noise(
        angle, root, position, stays, share[:, None] * given_angle, torch.where(marked, share * position, root)
    )


def _angles_of_positions(position: Float[Tensor, " batch"]) -> Float[Tensor, "batch joints"]:
    """Noise of a joint's angles about its parent where both bones point from one noisy position to another, radians."""
    own = (math.sqrt(2) * position[:, None] / _BONES.to(position)).clamp(max=_MAX_NOISE_RAD)
    own = own * torch.tensor([bool(CANONICAL.children(joint)) for joint in range(_JOINTS)])
    above = own[:, [max(0, parent) for parent in CANONICAL.parents]].clone()
    above[:, 0] = 0.0
    return (own.square() + above.square()).sqrt().clamp(max=_MAX_NOISE_RAD)


def _estimated_share(stays: Float[Tensor, " batch"]) -> Float[Tensor, " batch"]:
    """Return the estimate from fourth differences of noise that is correlated from frame to frame, as a share of
    its spread: 1 for white noise (`mapctl.recording.noise_estimation`)."""
    weights = torch.tensor([1.0, -4.0, 6.0, -4.0, 1.0])
    apart = (torch.arange(5)[:, None] - torch.arange(5)).abs()
    power = torch.einsum("i,bij,j->b", weights, stays[:, None, None] ** apart, weights)
    return (power / weights.square().sum()).sqrt()


def _perturb_positions(
    quats: Float[Tensor, "batch frames joints 4"], root: Float[Tensor, "batch frames 3"], noise: _Noise, draw: Draws
) -> tuple[Tensor, Tensor]:
    """Turn the bones of windows with noisy positions from each joint to the first one below, and move the hips."""
    rows = noise.position.nonzero()[:, 0]
    if len(rows) == 0:
        return quats, root
    white = torch.randn(len(rows), draw.frames, _JOINTS, 3, generator=draw.generator)
    moved = _correlate_in_time(white, noise.stays[rows]) * noise.position[rows, None, None, None]
    matrices = rotations.to_matrix(quats[rows])
    positions, world = chain_matrices(CANONICAL.offsets.to(matrices), CANONICAL.parents, matrices)
    world = world.clone()
    for joint in range(_JOINTS):
        if below := CANONICAL.children(joint):
            bone = positions[..., below[0], :] - positions[..., joint, :]
            turn = rotations.between_vectors(bone, bone + moved[..., below[0], :] - moved[..., joint, :])
            world[..., joint, :, :] = rotations.to_matrix(turn) @ world[..., joint, :, :]
    above = world[..., [max(0, parent) for parent in CANONICAL.parents], :, :]
    local = torch.cat([world[..., :1, :, :], (above.transpose(-1, -2) @ world)[..., 1:, :, :]], dim=-3)
    quats, root = quats.clone(), root.clone()
    quats[rows] = rotations.make_sign_continuous(rotations.from_matrix(local).movedim(1, 0)).movedim(0, 1)
    root[rows] += moved[..., 0, :]
    return quats, root


def _sample_spikes(draw: Draws) -> Float[Tensor, "batch frames joints 3"]:
    """Spikes of each angle, radians, in half of the windows; 0 elsewhere."""
    share = _SPIKES * draw.uniform() * (draw.uniform() < 0.5)
    hit = draw.uniform(draw.frames, _JOINTS, 3) < share[:, None, None, None]
    low, high = _SPIKE_DEG
    height = torch.deg2rad(low + (high - low) * draw.uniform(1, 1, 1))
    return hit * height * torch.sign(draw.normal(draw.frames, _JOINTS, 3))


def _turn_axes(angles: Float[Tensor, "batch frames joints 3"], draw: Draws) -> Tensor:
    """Rotation vectors of angles about axes of a window's rig.

    Noise is added to a rig's three channels, whose axes are square at best: near gimbal lock two of them are one.
    """
    skewed = torch.nn.functional.normalize(draw.normal(_JOINTS, 3, 3), dim=-1)
    square = torch.linalg.qr(draw.normal(_JOINTS, 3, 3))[0]
    axes = torch.where(draw.uniform(1, 1, 1) < 0.5, square, skewed)
    return torch.einsum("btjk,bjkc->btjc", angles, axes)


def _correlate_in_time(noise: Float[Tensor, "batch frames joints 3"], stays: Float[Tensor, " batch"]) -> Tensor:
    """Noise of the same spread, of which the share `stays` comes from the frame before."""
    if not stays.any():
        return noise
    kept, fresh = stays[:, None, None], torch.sqrt(1 - stays.square())[:, None, None]
    out = [noise[:, 0]]
    for frame in range(1, noise.shape[1]):
        out.append(kept * out[-1] + fresh * noise[:, frame])
    return torch.stack(out, dim=1)


def _sample_missing(draw: Draws) -> tuple[Tensor, Tensor]:
    """Which joints are lost (batch, frames, joints), and in which frames all are (batch, frames)."""
    share = _DROPOUT * draw.uniform(1, 1) * (draw.uniform(1, 1) < 1 / 3)
    lost = draw.uniform(draw.frames, _JOINTS) < share
    limb = draw.limb()
    during = _sample_interval(10, draw.frames, draw) & (draw.uniform(1) < _LIMB)
    nothing = _sample_interval(3, draw.frames // 3, draw) & (draw.uniform(1) < _GAP)
    return lost | (limb[:, None] & during[..., None]), nothing


def _sample_interval(shortest: int, longest: int, draw: Draws) -> Tensor:
    """One run of true frames in each window (batch, frames), never all of them."""
    shortest, longest = min(shortest, draw.frames - 1), min(longest, draw.frames - 1)
    length = shortest + draw.below(torch.full((draw.batch,), longest - shortest + 1))
    return draw.mark(draw.below(draw.frames - length + 1), length)


_TEMPO, _STRIDES = 0.15, 0.1  # largest changes of a copy's tempo and strides, as shares


def add_copies(corpus: Corpus, count: int, generator: torch.Generator) -> Corpus:
    """Return a corpus with so many copies of each clip after it, under the same names, at other tempos and strides."""
    if count == 0:
        return corpus
    windows = PoseWindows(corpus)
    names, clips = list(corpus.names), corpus.clips()
    for _ in range(count):
        for number, name in enumerate(corpus.names):
            change = 2 * torch.rand(2, generator=generator) - 1
            faster, wider = 1 + _TEMPO * float(change[0]), 1 + _STRIDES * float(change[1])
            if corpus.lengths[number] > 1 + faster:
                clips.append(copy_clip(windows, number, tempo=faster, strides=wider))
                names.append(name)
    return Corpus(tuple(names), tuple(map(len, clips)), torch.cat(clips), corpus.skipped, corpus.cuts)


def copy_clip(windows: PoseWindows, number: int, *, tempo: float, strides: float) -> Float[Tensor, "frames size"]:
    """Features of a corpus' clip at another tempo, with other strides: both are factors.

    Frames are interpolated where they lie between two; a toe is planted where it is in both.
    """
    clip = torch.tensor([number])
    frames = int((int(windows.lengths[number]) - 1) / tempo) + 1
    played = windows.at(clip, torch.zeros_like(clip), frames, torch.tensor([tempo]))
    vectors = rotations.to_rotation_vector(played.quats[0].double())
    pose = BodyPose(played.root_position[0].double(), played.heading[0].double(), vectors[:, 0, ::2], vectors[:, 1:])
    features = encode(change_strides(pose.motion(), strides))[0].float()
    time = tempo * torch.arange(frames)
    bits = windows.contacts.split(windows.lengths.tolist())[number]
    features[:, LAYOUT.slices["contacts"]] = bits[time.floor().long()] * bits[time.ceil().long()]
    return features


def change_strides(motion: Motion, factor: float) -> Motion:
    """Return a motion on canonical joints whose hips and feet go this many times as far over the ground.

    Toes keep their heights, feet their orientation, and what stands stands: all positions are scaled from one point of
    the floor, which also sets feet further apart. Legs reach there, and the hips go down where they would be too short.
    """
    if factor == 1:
        return motion  # legs as straight as can be would bend a little
    positions, scale = motion.joint_positions(), motion.root_position.new_tensor([factor, 1.0, factor])
    # From the toe joints on, which stand while the heel rises.
    ankles = scale * positions[:, TOES] + positions[:, FEET] - positions[:, TOES]
    stretch = limb_extension(motion, LEGS)
    moved = replace(motion, root_position=scale * motion.root_position)
    moved = lower_hips(fit_hips(moved, ankles, stretch), ankles, stretch)
    return reach_ankle_targets(moved, ankles)
