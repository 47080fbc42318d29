"""Spoilt copies of clean motion, as captures come: tremble, spikes, joints and limbs that are lost, moments without
anything. How much of each is drawn anew for every window, and the network is told the noise as a file's would be.

What all augmentations draw with: random numbers for a batch of windows, stretches of frames, and joints that go
together.

Copies of clips at other tempos and with other strides, for corpora of a few minutes.

Features hold rotations and the way of the hips, and priors are decoded on canonical bones: a body's proportions show in
them as how far and how high it steps alone. So a body with other legs is a motion whose feet go further or less far
over the same floor, and whose legs reach them; arms and trunk of other lengths would change nothing.

Splices: pieces of two clips and the stitcher's way between them, where each clip holds one thing done.

A density of such clips goes on with whatever it does: nothing shows it that who waves may walk off. Clips that begin or
stop going, change between a walk and a run, or do something else, are made by the stitcher (Ren et al. 2024) and kept
where they pass for mocap.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import metrics, rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, reversed_features
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.joint_roles import find_feet, find_hips
from mapctl.kinematics import chain_matrices
from mapctl.metrics.body import measure_longest_unsupported, measure_peaks
from mapctl.metrics.gait import GOES, RUNS, STANDS, WALKS
from mapctl.motion import Motion
from mapctl.pose import BodyPose, decode
from mapctl.recording import Capture
from mapctl.retarget.carry import fit_hips, lower_hips, reach_ankle_targets
from mapctl.retarget.character import FEET, LEGS, TOES, limb_extension
from mapctl.rotations import to_rotation_vector
from mapctl.runtime.stepwise import StepwiseWork
from mapctl.skeleton import CANONICAL
from priors.checkpoints import compute_hash
from priors.stitcher import MAX_CONTEXT, Stitcher, load
from priors.training.data import Corpus, measure_speeds, read_cache, write_cache
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

    def mark(self, start: Tensor, length: Tensor) -> Bool[Tensor, "batch frames"]:
        """True from each start on for so many frames."""
        frame = torch.arange(self.frames)
        return (frame >= start[:, None]) & (frame < (start + length)[:, None])


_JOINTS = CANONICAL.num_joints


@dataclass(frozen=True)
class CorruptionSettings:
    """Ranges that are drawn from, for each window."""

    angle_deg: tuple[float, float] = (0.3, 10.0)
    """Noise of each of a joint's three angles, log-uniform."""
    root_cm: tuple[float, float] = (0.2, 6.0)
    """Noise of each coordinate of the hips, log-uniform."""
    clean: float = 0.1
    """Share of windows whose angles, and share whose hips, have no noise."""
    uneven: float = 0.5
    """Spread (of the logarithm) of the noise among joints, in half of the windows."""
    markers: float = 0.25
    """Share of windows whose noise is that of the joints' positions: bones point from one noisy place to the next, so
    what a bone turns too far the next turns back."""
    marker_cm: tuple[float, float] = (0.5, 6.0)
    """Noise of the joints' positions, log-uniform."""
    correlated: float = 0.3
    """Share of windows whose noise lasts beyond a frame, as that of a capture which was filtered before."""
    lasting: float = 0.9
    """Largest share of such noise that comes from the frame before."""
    untold: float = 0.5
    """Share of these windows whose noise the network is told as an estimate from frame to frame would tell it: less."""
    spikes: float = 0.02
    """Largest share of an angle's frames that are spikes, in half of the windows."""
    spike_deg: tuple[float, float] = (15.0, 60.0)
    """Height of the spikes."""
    found: float = 0.8
    """Share of the spikes that are taken for what they are, and masked."""
    dropout: float = 0.4
    """Largest share of a joint's frames that are lost, in a third of the windows."""
    limb: float = 0.25
    """Share of windows that lose a limb for a while."""
    gap: float = 0.1
    """Share of windows that lose everything for a while."""
    told: float = 0.2
    """Error (of the logarithm) of the noise level that the network is given."""
    size: float = 0.05
    """Spread of a performer's size: of the logarithm of the distance that the hips travel."""


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


def corrupt(clean: Capture, settings: CorruptionSettings, generator: torch.Generator) -> Capture:
    """A spoilt copy; what is masked keeps its values, which nobody should look at."""
    draw = Draws(generator, *clean.root.shape[:2])
    noise = _sample_noise(settings, draw)
    spikes = _sample_spikes(settings, draw)
    quats = torch.cat([clean.hips[:, :, None], rotations.from_rotation_vector(clean.joints)], dim=2)
    quats, root = _perturb_places(quats, clean.root, noise, draw)
    angles = _correlate_in_time(draw.normal(draw.frames, _JOINTS, 3), noise.stays) * noise.angle[:, None, :, None]
    quats = rotations.multiply(quats, rotations.from_rotation_vector(_turn_axes(angles + spikes, draw)))
    root = root + draw.normal(draw.frames, 3) * noise.root[:, None, None]
    lost, nothing = _sample_missing(settings, draw)
    found = (spikes != 0).any(dim=-1) & (draw.uniform(draw.frames, _JOINTS) < settings.found)
    error = torch.exp(settings.told * draw.normal(_JOINTS + 1))
    return Capture(
        root,
        quats[:, :, 0],
        rotations.to_rotation_vector(quats[:, :, 1:]),
        ~nothing,
        ~(lost | found | nothing[..., None]),
        noise.told_root * error[:, -1],
        noise.told_angle * error[:, :-1],
    )


@dataclass(frozen=True, eq=False)
class _Noise:
    """How noisy each window of a batch is."""

    angle: Float[Tensor, "batch joints"]
    """Of each of a joint's angles, radians; 0 where places are noisy."""
    root: Float[Tensor, " batch"]
    """Of each coordinate of the hips, metres; 0 where places are noisy."""
    place: Float[Tensor, " batch"]
    """Of each coordinate of every joint's place, metres; 0 where angles are noisy."""
    stays: Float[Tensor, " batch"]
    """Share of the noise that comes from the frame before."""
    told_angle: Float[Tensor, "batch joints"]
    """Noise of angles that the network is told, radians."""
    told_root: Float[Tensor, " batch"]
    """Noise of the hips' place that it is told, metres."""


_MAX_NOISE_RAD = 0.6  # radians of noise; more is no noise but another motion


def _bone_lengths() -> Float[Tensor, " joints"]:
    """From each canonical joint to the next, metres; of the last ones, the bone before."""
    lengths = CANONICAL.offsets.norm(dim=-1).float()
    return torch.stack(
        [lengths[below[0]] if (below := CANONICAL.children(joint)) else lengths[joint] for joint in range(_JOINTS)]
    )


def _sample_noise(settings: CorruptionSettings, draw: Draws) -> _Noise:
    """Draw the noise of angles and the hips, or that of all places."""
    angle = torch.deg2rad(draw.log_uniform(*settings.angle_deg, 1)) * (draw.uniform(1) > settings.clean)
    uneven = torch.where(draw.uniform(1) < 0.5, settings.uneven, 0.0) * draw.normal(_JOINTS)
    root = draw.log_uniform(*settings.root_cm) / 100 * (draw.uniform() > settings.clean)
    marked = draw.uniform() < settings.markers
    place = torch.where(marked, draw.log_uniform(*settings.marker_cm) / 100, 0.0)
    angle, root = torch.where(marked[:, None], 0.0, angle * torch.exp(uneven)), torch.where(marked, 0.0, root)
    stays = torch.where(draw.uniform() < settings.correlated, settings.lasting * draw.uniform(), 0.0)
    share = torch.where(draw.uniform() < settings.untold, _estimated_share(stays), 1.0)
    told_angle = torch.where(marked[:, None], _angles_of_places(place), angle)
    return _Noise(angle, root, place, stays, share[:, None] * told_angle, torch.where(marked, share * place, root))


def _angles_of_places(place: Float[Tensor, " batch"]) -> Float[Tensor, "batch joints"]:
    """Noise of a joint's angles about its parent where both bones point from one noisy place to another, radians."""
    own = (math.sqrt(2) * place[:, None] / _bone_lengths().to(place)).clamp(max=_MAX_NOISE_RAD)
    own = own * torch.tensor([bool(CANONICAL.children(joint)) for joint in range(_JOINTS)])
    above = own[:, [max(0, parent) for parent in CANONICAL.parents]].clone()
    above[:, 0] = 0.0
    return (own.square() + above.square()).sqrt().clamp(max=_MAX_NOISE_RAD)


def _estimated_share(stays: Float[Tensor, " batch"]) -> Float[Tensor, " batch"]:
    """What an estimate from fourth differences makes of noise of which so much stays from frame to frame, as a share of
    its spread: 1 for white noise (`mapctl.recording.noise_estimation`)."""
    weights = torch.tensor([1.0, -4.0, 6.0, -4.0, 1.0])
    apart = (torch.arange(5)[:, None] - torch.arange(5)).abs()
    power = torch.einsum("i,bij,j->b", weights, stays[:, None, None] ** apart, weights)
    return (power / weights.square().sum()).sqrt()


def _perturb_places(
    quats: Float[Tensor, "batch frames joints 4"], root: Float[Tensor, "batch frames 3"], noise: _Noise, draw: Draws
) -> tuple[Tensor, Tensor]:
    """Turn the bones of windows whose places are noisy from each noisy place to that of the first joint below, and move
    the hips by their own noise."""
    rows = noise.place.nonzero()[:, 0]
    if len(rows) == 0:
        return quats, root
    white = torch.randn(len(rows), draw.frames, _JOINTS, 3, generator=draw.generator)
    moved = _correlate_in_time(white, noise.stays[rows]) * noise.place[rows, None, None, None]
    matrices = rotations.to_matrix(quats[rows])
    places, world = chain_matrices(CANONICAL.offsets.to(matrices), CANONICAL.parents, matrices)
    world = world.clone()
    for joint in range(_JOINTS):
        if below := CANONICAL.children(joint):
            bone = places[..., below[0], :] - places[..., joint, :]
            turn = rotations.between_vectors(bone, bone + moved[..., below[0], :] - moved[..., joint, :])
            world[..., joint, :, :] = rotations.to_matrix(turn) @ world[..., joint, :, :]
    above = world[..., [max(0, parent) for parent in CANONICAL.parents], :, :]
    local = torch.cat([world[..., :1, :, :], (above.transpose(-1, -2) @ world)[..., 1:, :, :]], dim=-3)
    quats, root = quats.clone(), root.clone()
    quats[rows] = rotations.make_sign_continuous(rotations.from_matrix(local).movedim(1, 0)).movedim(0, 1)
    root[rows] += moved[..., 0, :]
    return quats, root


def _sample_spikes(settings: CorruptionSettings, draw: Draws) -> Float[Tensor, "batch frames joints 3"]:
    """Spikes of each angle, radians, in half of the windows; 0 elsewhere."""
    share = settings.spikes * draw.uniform() * (draw.uniform() < 0.5)
    hit = draw.uniform(draw.frames, _JOINTS, 3) < share[:, None, None, None]
    low, high = settings.spike_deg
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


def _sample_missing(settings: CorruptionSettings, draw: Draws) -> tuple[Tensor, Tensor]:
    """Which joints are lost (batch, frames, joints), and in which frames all are (batch, frames)."""
    share = settings.dropout * draw.uniform(1, 1) * (draw.uniform(1, 1) < 1 / 3)
    lost = draw.uniform(draw.frames, _JOINTS) < share
    limb = draw.limb()
    during = _sample_interval(10, draw.frames, draw) & (draw.uniform(1) < settings.limb)
    nothing = _sample_interval(3, draw.frames // 3, draw) & (draw.uniform(1) < settings.gap)
    return lost | (limb[:, None] & during[..., None]), nothing


def _sample_interval(shortest: int, longest: int, draw: Draws) -> Tensor:
    """One run of true frames in each window (batch, frames), never all of them."""
    shortest, longest = min(shortest, draw.frames - 1), min(longest, draw.frames - 1)
    length = shortest + draw.below(torch.full((draw.batch,), longest - shortest + 1))
    return draw.mark(draw.below(draw.frames - length + 1), length)


def add_copies(corpus: Corpus, count: int, generator: torch.Generator, *, tempo: float, strides: float) -> Corpus:
    """Return a corpus with its clips, and after them so many copies of each, under the same names, whose tempo and
    strides differ by these shares at most."""
    if count == 0:
        return corpus
    windows = PoseWindows(corpus, kinds=(), evenness=0.0)
    names, clips = list(corpus.names), corpus.clips()
    for _ in range(count):
        for number, name in enumerate(corpus.names):
            change = 2 * torch.rand(2, generator=generator) - 1
            faster, wider = 1 + tempo * float(change[0]), 1 + strides * float(change[1])
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
    features = encode(change_strides(_as_motion(played), strides))[0].float()
    time = tempo * torch.arange(frames)
    bits = windows.contacts.split(windows.lengths.tolist())[number]
    features[:, LAYOUT.slices["contacts"]] = bits[time.floor().long()] * bits[time.ceil().long()]
    return features


def change_strides(motion: Motion, factor: float) -> Motion:
    """Return a motion on canonical joints whose hips and feet go this many times as far over the ground.

    Toes keep their heights, feet their orientation, and what stands stands: all places are scaled from one point of
    the floor, which also sets feet further apart. Legs reach there, and the hips go down where they would be too short.
    """
    if factor == 1:
        return motion  # legs as straight as can be would bend a little
    places, scale = motion.joint_positions(), motion.root_position.new_tensor([factor, 1.0, factor])
    # From the toe joints on, which stand while the heel rises.
    ankles = scale * places[:, TOES] + places[:, FEET] - places[:, TOES]
    stretch = limb_extension(motion, LEGS)
    moved = replace(motion, root_position=scale * motion.root_position)
    moved = lower_hips(fit_hips(moved, ankles, stretch), ankles, stretch)
    return reach_ankle_targets(moved, ankles)


def _as_motion(played: PartialMotion) -> Motion:
    """The first of a batch of motions of which everything is known."""
    vectors = to_rotation_vector(played.quats[0].double())
    pose = BodyPose(played.root_position[0].double(), played.heading[0].double(), vectors[:, 0, ::2], vectors[:, 1:])
    return pose.motion()


CHECKED = (
    "contact_speed_cm_s",
    "penetration_cm",
    "jitter_m_s3",
    "largest_step_cm",
    "largest_acceleration_m_s2",
    "longest_slide_s",
)
"""Mean speed of planted toes, depth under the floor, mean jerk; over all joints and frames the largest step about the
hips in a thirtieth of a second, and the largest acceleration; and for how long the body goes while no low toe
stands."""
_RANGE = 95.0  # percentile over the reference's clips that no made clip may exceed
_LEAST_FRAMES = 30  # of a clip that says something


def measure_checked(motion: Motion) -> dict[str, float]:
    """The measures of CHECKED of a motion."""
    found, places = metrics.measure(motion), motion.joint_positions()
    hips, toes = places[:, find_hips(motion.skeleton)], places[:, list(find_feet(motion.skeleton))]
    fps = float(motion.fps)
    peaks = measure_peaks(places, hips, fps)
    own = {
        "largest_step_cm": 100 * peaks.step,
        "largest_acceleration_m_s2": peaks.acceleration,
        "longest_slide_s": measure_longest_unsupported(toes, hips, fps),
    }
    return {name: own.get(name, found.get(name, math.nan)) for name in CHECKED}


def find_bounds(reference: Iterable[Motion]) -> dict[str, float]:
    """By measure what 95 % of the clips stay under; clips of less than a second say nothing."""
    rows = [measure_checked(motion) for motion in reference if motion.num_frames >= _LEAST_FRAMES]
    return {name: float(np.nanpercentile([row[name] for row in rows], _RANGE)) for name in CHECKED if rows}


FOLDER = "spliced/"
"""Before the names of splices in a corpus, which are those of both clips."""
_STANDING, _GOING, _WALKING, _RUNNING = (0.0, STANDS), (GOES, math.inf), (GOES, WALKS), (RUNS, math.inf)
_KINDS = (
    (_STANDING, _GOING),
    (_GOING, _STANDING),
    (_STANDING, _STANDING),
    # Twice as often, since fewer of them pass for mocap.
    *(2 * ((_WALKING, _RUNNING), (_RUNNING, _WALKING))),
)
"""Who sets off, who stops, who stands and does something else, who begins to run, who slows down to a walk: the
smoothed speeds, m/s, between which the first piece ends and the second begins."""
_PIECE = 45, 120  # frames of a piece
_GAPS = range(15, 60, 5)  # frames between two: few lengths, each of which is walked at once
_GAP_A_SPEED = 12.0  # frames by which a gap is longer for each m/s of difference
_TURN = 0.5  # standard deviation of the turn between two pieces, radians
_REFERENCE = 300  # clips whose measures bound those of the splices of one kind
_AT_ONCE = 64  # splices that are walked at once
_VELOCITY_FRAMES = 5  # frames over which the velocity at a cut is estimated


@dataclass(frozen=True)
class SpliceCut:
    """Where a splice goes from one clip to another."""

    clips: tuple[int, int]
    """Numbers of the first and the second clip."""
    first: slice
    """Frames of the first clip, up to the last before the gap."""
    second: slice
    """Frames of the second clip, from the first after the gap on."""
    gap: int
    """Frames between the two."""
    turn: float
    """Of the heading from the one to the other, radians."""
    kind: tuple[tuple[float, float], tuple[float, float]]
    """Speeds, m/s, between which the first piece ends, and between which the second begins."""


def add_splices(
    corpus: Corpus, count: int, name: str = "stitcher", cache: Path | None = None, *, seed: int = 1
) -> Corpus:
    """Return a corpus with its clips, and after them those of so many splices that no measure separates from mocap,
    under names that begin with FOLDER. `name` is the stitcher, bundled or trained. In the folder `cache` they are kept:
    a run that is resumed reads them.

    Who stands sets off, who goes stops, and who stands does something else, as often each where the clips have it, and
    twice as often who walks begins to run, and who runs slows down to a walk; the second piece begins where velocities
    of both lead. RequestError for a corpus with nothing of it, CheckpointError for a stitcher that is none.
    """
    if count == 0:
        return corpus
    stitcher = load(name)
    drawn = {**corpus.identity(), "count": count, "stitcher": compute_hash(name), "seed": seed}
    key = sha256(json.dumps(drawn, sort_keys=True).encode()).hexdigest()[:16]
    stored = cache / f"splices-{key}.safetensors" if cache else None
    kept = read_cache(stored) if stored else None
    if kept is None:
        kept = _make_splices(corpus, count, stitcher, torch.Generator().manual_seed(seed))
        if stored:
            write_cache(kept, stored)
    return replace(
        corpus,
        names=corpus.names + kept.names,
        lengths=corpus.lengths + kept.lengths,
        features=torch.cat([corpus.features, kept.features]),
    )


def _make_splices(corpus: Corpus, count: int, stitcher: Stitcher, generator: torch.Generator) -> Corpus:
    """Make those that pass for mocap, without the clips."""
    clips = corpus.clips()
    gaps = [gap for gap in _GAPS if gap <= stitcher.longest] or [stitcher.longest]
    cuts = draw_cuts(corpus, count, gaps, generator)
    spliced = _walk_all(clips, cuts, stitcher, generator)
    bounds = {kind: _bound(clips, [cut for cut in cuts if cut.kind == kind]) for kind in {cut.kind for cut in cuts}}
    kept = [number for number, features in enumerate(spliced) if _passes(features, bounds[cuts[number].kind])]
    return Corpus(
        tuple(FOLDER + " + ".join(corpus.names[clip] for clip in cuts[number].clips) for number in kept),
        tuple(len(spliced[number]) for number in kept),
        torch.cat([corpus.features[:0], *(spliced[number] for number in kept)]),
    )


def _bound(clips: Sequence[Tensor], cuts: Sequence[SpliceCut]) -> dict[str, float]:
    """Bound the measures of splices of one kind by the clips they are of: who runs steps further than who stands."""
    numbers = sorted({number for cut in cuts for number in cut.clips})
    spread = numbers[:: math.ceil(len(numbers) / _REFERENCE)]
    return find_bounds(decode(clips[number], GroundPose.origin()) for number in spread)


def drop_splices(corpus: Corpus) -> Corpus:
    """Return a corpus without its splices."""
    return corpus.subset(number for number, name in enumerate(corpus.names) if not name.startswith(FOLDER))


def hide_splices(names: Sequence[str]) -> list[str]:
    """Hide the names of splices, from which labels would be read that hold for one of the two clips alone."""
    return ["" if name.startswith(FOLDER) else name for name in names]


def draw_cuts(corpus: Corpus, count: int, gaps: Sequence[int], generator: torch.Generator) -> list[SpliceCut]:
    """Draw where pieces of two clips are cut, of each kind in turn, and which of the gaps lies between; RequestError
    for a corpus in which nobody stands, or both walks and runs, for a piece."""
    speeds = measure_speeds(corpus)
    ends = {speed: _find_frames(speeds, speed, lead=_PIECE[0]) for speed in {a for a, _ in _KINDS}}
    beginnings = {speed: _find_frames(speeds, speed, rest=_PIECE[0]) for speed in {b for _, b in _KINDS}}
    kinds = [(a, b) for a, b in _KINDS if len(ends[a]) and len(beginnings[b])]
    if not kinds:
        raise RequestError(
            f"splices need clips of {_PIECE[0] / PRIOR_FPS:g} s in which somebody stands, or both walks and runs"
        )

    def pick(frames: Tensor) -> tuple[int, int]:
        clip, frame = frames[int(torch.randint(len(frames), (), generator=generator))].tolist()
        return clip, frame

    cuts = []
    for number in range(count):
        kind = a, b = kinds[number % len(kinds)]
        (one, last), (other, first) = pick(ends[a]), pick(beginnings[b])
        lengths = torch.randint(_PIECE[0], _PIECE[1] + 1, (2,), generator=generator).tolist()
        change = abs(float(speeds[one][last] - speeds[other][first]))
        wanted = _GAPS[0] + _GAP_A_SPEED * change + float(torch.rand((), generator=generator)) * _GAPS[0]
        cuts.append(
            SpliceCut(
                (one, other),
                slice(max(0, last + 1 - lengths[0]), last + 1),
                slice(first, first + lengths[1]),
                min(gaps, key=lambda gap: abs(gap - wanted)),
                _TURN * float(torch.randn((), generator=generator)),
                kind,
            )
        )
    return cuts


def _find_frames(
    speeds: Sequence[Tensor], wanted: tuple[float, float], *, lead: int = 1, rest: int = 0
) -> Int[Tensor, "found 2"]:
    """Clip and frame of all frames whose speed lies between those wanted, m/s, with so many frames up to it and so many
    after it."""
    found = [torch.empty(0, 2, dtype=torch.long)]
    for clip, speed in enumerate(speeds):
        frames = torch.arange(lead - 1, max(lead - 1, len(speed) - rest))
        frames = frames[(wanted[0] <= speed[frames]) & (speed[frames] < wanted[1])]
        found.append(torch.stack([torch.full_like(frames, clip), frames], dim=1))
    return torch.cat(found)


def _walk_all(
    clips: Sequence[Tensor], cuts: Sequence[SpliceCut], stitcher: Stitcher, generator: torch.Generator
) -> list[Float[Tensor, "frames size"]]:
    """The splices of all cuts, those with one length of gap together."""
    spliced: dict[int, Tensor] = {}
    for gap in sorted({cut.gap for cut in cuts}):
        numbers = [number for number, cut in enumerate(cuts) if cut.gap == gap]
        for begin in range(0, len(numbers), _AT_ONCE):
            part = numbers[begin : begin + _AT_ONCE]
            walked = _walk(clips, [cuts[number] for number in part], stitcher, generator)
            spliced |= dict(zip(part, walked, strict=True))
    return [spliced[number] for number in range(len(cuts))]


def _walk(
    clips: Sequence[Tensor], cuts: Sequence[SpliceCut], stitcher: Stitcher, generator: torch.Generator
) -> list[Float[Tensor, "frames size"]]:
    """The splices of cuts with one length of gap."""
    frames, context = cuts[0].gap + 1, MAX_CONTEXT + 2
    first = [clips[cut.clips[0]][cut.first] for cut in cuts]
    second = [clips[cut.clips[1]][cut.second] for cut in cuts]
    before = torch.stack([piece[-context:] for piece in first])
    after = torch.stack([piece[:context] for piece in second])
    turn = torch.tensor([cut.turn for cut in cuts])
    leaving, arriving = (
        _average_velocity(before[:, -_VELOCITY_FRAMES:]),
        _average_velocity(after[:, 1 : 1 + _VELOCITY_FRAMES]),
    )
    place = frames / 2 * (leaving + rotations.rotate_ground(arriving, turn))
    ways = StepwiseWork(
        stitcher.connect(before, reversed_features(after), place, turn, frames, noise=generator)
    ).finish()
    return [torch.cat([one, way, other[1:]]) for one, way, other in zip(first, ways, second, strict=True)]


def _average_velocity(features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch 2"]:
    """Over the ground at a cut, metres a frame, in the headings of its frames."""
    return LAYOUT.pick(features, "root_displacement_heading").mean(dim=1)


def _passes(features: Float[Tensor, "frames size"], bounds: Mapping[str, float]) -> bool:
    """Whether no measure exceeds its bound; what cannot be measured, as of feet that never stand, does."""
    if not bool(torch.isfinite(features).all()):
        return False
    found = measure_checked(decode(features, GroundPose.origin()))
    return all(found[name] <= bound for name, bound in bounds.items())
