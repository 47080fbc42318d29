"""Windows of a corpus, as training draws them: of its features, of joint positions, and of whole poses of bodies and
tempos that vary, half of them mirrored.

Windows may be in poses that no clip shows: joints turned by constants that drift, bodies tilted up to lying and
lowered. A model that has seen the poses of one performer alone returns to them where it should not. Truth and input are
changed alike, so the task stays the same.
"""

import math
import re
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.contacts import ContactSettings
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, mirror_features
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, mirror_quats
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.data import Corpus, find_window_starts, number_clip_folders

KINDS = ("walk-turn", "walk", "run|dash", "^cmu")
"""Kinds of clips, as patterns of their names, among which windows are evened; clips of none are another kind."""
_EVENNESS = 0.85  # among these kinds: 0 draws by their frames, 1 the same number of each
_CHUNK_FRAMES = 50_000  # frames
_GOING = 0.25  # m/s that the hips of a walking character reach, on average over the frames around one
_AROUND = 9  # frames, so that a shift of weight is no walk


@dataclass(frozen=True, eq=False)
class FeatureBatch:
    """Windows of features."""

    features: Float[Tensor, "batch window size"]  # as in the corpus, or mirrored
    first: Int[Tensor, " batch"]  # frame of the joined corpus that each begins with
    mirrored: Bool[Tensor, " batch"]  # whether left and right are exchanged


class FeatureWindows:
    """Draws windows from a corpus."""

    def __init__(self, corpus: Corpus, frames: int, *, evenness: float = 0.0, standing_share: float = 1.0):
        """`evenness` among the corpus' top folders: 0 draws by their frames, 1 the same number from each. Windows in
        which the hips stay under 0.25 m/s are drawn `standing_share` times as often as others. RequestError where no
        clip is as long as a window.
        """
        self.features, self.frames = corpus.features, frames
        self.starts = find_window_starts(corpus.lengths, frames)
        folder = number_clip_folders(corpus).repeat_interleave(torch.tensor(corpus.lengths))[self.starts]
        chance = torch.bincount(folder).double()[folder] ** -evenness
        if standing_share < 1:
            chance[_find_standing(self.features, frames)[self.starts]] *= standing_share
        self.chances = chance.cumsum(0)

    def draw(self, batch: int, generator: torch.Generator) -> FeatureBatch:
        """So many, half of them mirrored."""
        at = self.chances[-1] * torch.rand(batch, generator=generator, dtype=torch.float64)
        first = self.starts[torch.searchsorted(self.chances[:-1], at, right=True)]
        windows = self.features[first[:, None] + torch.arange(self.frames)]
        mirrored = torch.rand(batch, generator=generator) < 0.5
        windows = torch.where(mirrored[:, None, None], mirror_features(windows), windows)
        return FeatureBatch(windows, first, mirrored)


def _find_standing(features: Float[Tensor, "frames size"], window: int) -> Bool[Tensor, " windows"]:
    """Find the windows of so many frames, from each frame on, in which a character stands."""
    around = torch.full((1, 1, _AROUND), 1 / _AROUND)
    padded = torch.nn.functional.pad(ground_speed(features)[None, None], (_AROUND // 2, _AROUND // 2), mode="replicate")
    return torch.nn.functional.conv1d(padded, around)[0, 0].unfold(0, window, 1).amax(-1) < _GOING


_WIDE = {"UpperArm": 0.6, "LowerArm": 0.5, "UpperLeg": 0.5, "LowerLeg": 0.5}
_LOWERING = 0.6  # metres by which tilted hips are lowered, at most
_TURN_SIGMA = torch.tensor(
    [0.0] + [next((wide for part, wide in _WIDE.items() if part in name), 0.3) for name in CANONICAL.names[1:]]
)
"""Spread of a joint's rotation vector, radians; the hips are tilted instead."""


@dataclass(frozen=True)
class PoseVariation:
    """How far windows leave the poses of their clips."""

    share: float = 0.7
    """Share of windows whose joints are turned, each by normal rotation vectors times one uniform number a window."""
    drift: float = 0.3
    """Turn that is added over the window, as a share of the first."""
    tilted: float = 0.35
    """Share of windows whose hips are tilted about a horizontal axis, by up to 1.6 radians, and lowered."""


def vary_poses(
    heading: Float[Tensor, "batch frames"],
    quats: Float[Tensor, "batch frames joints 4"],
    height: Float[Tensor, "batch frames"],
    variation: PoseVariation,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "batch frames"], Float[Tensor, "batch frames joints 4"], Float[Tensor, "batch frames"]]:
    """Return headings (radians), rotations (the hips' without heading) and hips heights (metres) in other poses."""
    batch, frames, joints = quats.shape[:3]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator)

    def turn(size: float) -> Tensor:
        return size * _TURN_SIGMA[:, None] * torch.randn(batch, 1, joints, 3, generator=generator)

    amount = (uniform() < variation.share) * uniform()
    progress = torch.linspace(0, 1, frames)[:, None, None]
    vectors = amount[:, None, None, None] * (turn(1.0) + progress * turn(variation.drift))
    tilted, about = uniform() < variation.tilted, 2 * math.pi * uniform()
    axis = torch.stack([about.cos(), torch.zeros(batch), about.sin()], dim=-1)
    tilt = rotations.from_rotation_vector((tilted * 1.6 * uniform())[:, None] * axis)
    lowered = height - (tilted * _LOWERING * uniform())[:, None]
    quats = rotations.multiply(quats, rotations.from_rotation_vector(vectors))
    hips = rotations.multiply(tilt[:, None].expand(-1, frames, -1), quats[..., 0, :])
    turned, upright = rotations.split_heading(hips)
    quats = torch.cat([upright[..., None, :], quats[..., 1:, :]], dim=-2)
    return heading + rotations.unwrap_angle(turned), quats, torch.where(tilted[:, None], lowered, height)


def vary_features(
    features: Float[Tensor, "batch frames size"], variation: PoseVariation, generator: torch.Generator
) -> Float[Tensor, "batch frames size"]:
    """Return the features of windows in other poses."""
    pose = BodyPose.of_features(features, GroundPose.origin())
    quats = rotations.from_rotation_vector(pose.rotation_vectors)
    heading, quats, height = vary_poses(pose.heading, quats, pose.root_position[..., 1], variation, generator)
    root = torch.stack([pose.root_position[..., 0], height, pose.root_position[..., 2]], dim=-1)
    vectors = rotations.to_rotation_vector(quats)
    varied = BodyPose(root, heading, vectors[..., 0, ::2], vectors[..., 1:, :])
    planted = keep_still(LAYOUT.pick(features, "contacts"), varied.joints_world())
    return varied.features(GroundPose.origin(), planted > 0)


def keep_still(
    contacts: Float[Tensor, "batch frames 2"], positions: Float[Tensor, "batch frames joints 3"]
) -> Float[Tensor, "batch frames 2"]:
    """Keep contacts of toes that still do not travel; world positions, metres."""
    toes = positions[..., list(TOE_JOINTS), ::2]
    speed = torch.diff(toes, dim=1, prepend=toes[:, :1]).norm(dim=-1) * PRIOR_FPS
    return contacts * (speed < ContactSettings.slow)


_VARIED = (
    (("leftShoulder", "rightShoulder", "leftUpperArm", "rightUpperArm"), 1),
    (("leftUpperLeg", "rightUpperLeg"), 1),
    (("spine", "chest", "neck", "head"), 3),
    (("leftLowerArm", "rightLowerArm"), 3),
    (("leftHand", "rightHand"), 3),
)
"""Joints whose bones vary together, and how many of their axes: widths along x alone, lengths along all."""


TEMPO, _BONES = 0.1, 0.15
"""Largest changes, as shares, of tempo, and of the widths of shoulders and hips and of the lengths of trunk, forearms
and hands: legs keep their length, the unit of all others. Half of the windows vary in the one, half in the other."""


class WindowPicker:
    """Picks where windows begin in a corpus, clips of all KINDS about alike."""

    def __init__(self, corpus: Corpus):
        self.lengths = corpus.locate_clips()[0]
        kind = torch.tensor([find_kind(name) for name in corpus.names])
        share = torch.zeros(len(KINDS) + 1).index_add(0, kind, self.lengths.float())
        self.weights = share[kind] ** -_EVENNESS

    def pick(
        self, span: Int[Tensor, " batch"], generator: torch.Generator
    ) -> tuple[Int[Tensor, " batch"], Int[Tensor, " batch"]]:
        """Pick clips, and first frames of windows of so many frames; RequestError where no clip is so long."""
        room = (self.lengths - int(span.max()) + 1).clamp_min(0).float()
        if not bool(room.any()):
            raise RequestError(f"no clip is as long as the window of {int(span.max())} frames")
        clip = torch.multinomial(room * self.weights, len(span), replacement=True, generator=generator)
        return clip, (torch.rand(len(span), generator=generator) * (self.lengths[clip] - span + 1)).long()


class PoseWindows:
    """Draws windows from a corpus."""

    def __init__(self, corpus: Corpus):
        self.picker = WindowPicker(corpus)
        self.lengths, self.starts = corpus.locate_clips()
        self.ground, self.heading = corpus.integrate_roots()
        self.height = LAYOUT.pick(corpus.features, "root_height")
        self.contacts = LAYOUT.pick(corpus.features, "contacts")
        poses = [BodyPose.of_features_in_place(part) for part in corpus.features.split(_CHUNK_FRAMES)]
        self.quats = torch.cat([rotations.from_rotation_vector(pose.rotation_vectors) for pose in poses])

    def draw(
        self, batch: int, frames: int, generator: torch.Generator, *, variation: PoseVariation | None = None
    ) -> PartialMotion:
        """So many windows of so many frames, of which everything is known; a `variation` varies tempo, bones and poses.
        RequestError where no clip is so long."""
        tempo = torch.ones(batch)
        if variation is not None:
            chosen = torch.rand(batch, generator=generator) < 0.5
            change = TEMPO * (2 * torch.rand(batch, generator=generator) - 1)
            tempo = torch.where(chosen, 1 + change, 1.0)
        clip, first = self.picker.pick(1 + ((frames - 1) * tempo).ceil().long(), generator)
        window = self.at(clip, first, frames, tempo)
        mirrored = torch.rand(batch, generator=generator) < 0.5
        window = choose_rows(mirrored, window.mirrored(), window)
        if variation is None:
            return window
        window = _reshape_bodies(window, generator)
        root = window.root_position.clone()
        heading, quats, root[..., 1] = vary_poses(window.heading, window.quats, root[..., 1], variation, generator)
        varied = replace(window, root_position=root, heading=heading, quats=quats)
        return replace(varied, contacts=keep_still(window.contacts, varied.world_poses()[0]))

    def at(
        self, clip: Int[Tensor, " batch"], first: Int[Tensor, " batch"], frames: int, tempo: Float[Tensor, " batch"]
    ) -> PartialMotion:
        """From these frames of these clips on, in steps of `tempo` frames."""
        time = first[:, None] + torch.arange(frames) * tempo[:, None].double()
        return self.gather(clip[:, None].expand_as(time), time)

    def gather(self, clip: Int[Tensor, "batch frames"], time: Float[Tensor, "batch frames"]) -> PartialMotion:
        """Gather frames of clips at times in frames, which may lie between two; beyond a clip's last, that one."""
        low = time.floor().long()
        weight = (time - low).float()
        last = self.lengths[clip] - 1
        one, other = (self.starts[clip] + at.minimum(last) for at in (low, low + 1))
        nearest = torch.where(weight < 0.5, one, other)
        quats, after = self.quats[one], self.quats[other]
        after = torch.where((quats * after).sum(dim=-1, keepdim=True) < 0, -after, after)
        quats = torch.nn.functional.normalize(torch.lerp(quats, after, weight[..., None, None]), dim=-1)
        ground = torch.lerp(self.ground[one], self.ground[other], weight[..., None])
        height = torch.lerp(self.height[one], self.height[other], weight[..., None])
        root = torch.cat([ground[..., :1], height, ground[..., 1:]], dim=-1)
        heading = torch.lerp(self.heading[one], self.heading[other], weight)
        batch, frames = clip.shape
        offsets = CANONICAL.offsets.to(root).expand(batch, -1, -1)
        known = KnownParts.whole(torch.ones(batch, frames, dtype=torch.bool))
        return PartialMotion(root, heading, quats, self.contacts[nearest], offsets, known)

    def mean_quats(self) -> Float[Tensor, "joints 4"]:
        """Mean rotation of each joint, of a motion and its mirror image."""
        sample = self.quats[:: max(1, len(self.quats) // 20_000)]
        return rotations.average(torch.cat([sample, mirror_quats(sample)]).double()).float()


def draw_length(shortest: int, longest: int, generator: torch.Generator) -> int:
    """Draw the frames of windows, as often of each octave; the shortest where the longest is shorter."""
    share = float(torch.rand((), generator=generator))
    return round(shortest * (max(shortest, longest) / shortest) ** share)


def find_kind(name: str) -> int:
    """Number of the first of KINDS that is in a clip's name; that of none is one more than the last."""
    return next((number for number, kind in enumerate(KINDS) if re.search(kind, name)), len(KINDS))


def choose_rows(chosen: Tensor, one: PartialMotion, other: PartialMotion) -> PartialMotion:
    """Take rows of one where they are chosen, of the other elsewhere; both know everything."""

    def pick(name: str) -> Tensor:
        first = getattr(one, name)
        return torch.where(chosen.view(-1, *[1] * (first.ndim - 1)), first, getattr(other, name))

    names = ("root_position", "heading", "quats", "contacts", "offsets")
    return replace(other, **{name: pick(name) for name in names})


def _reshape_bodies(window: PartialMotion, generator: torch.Generator) -> PartialMotion:
    """Give bodies other widths and lengths, the same on both sides."""
    batch = len(window.offsets)
    factors = torch.ones(batch, CANONICAL.num_joints, 3)
    for joints, axes in _VARIED:
        factor = 1 + _BONES * (2 * torch.rand(batch, generator=generator) - 1)
        factors[:, CANONICAL.indices(joints), :axes] = factor[:, None, None]
    chosen = (torch.rand(batch, generator=generator) < 0.5)[:, None, None]
    return replace(window, offsets=torch.where(chosen, window.offsets * factors, window.offsets))


def measure_lengths(vectors: Float[Tensor, "*batch axes"], least: float = 1e-10) -> Float[Tensor, "*batch"]:
    """Norms whose gradient is finite at zero: their squares are `least` at least."""
    return (vectors.square().sum(dim=-1) + least).sqrt()
