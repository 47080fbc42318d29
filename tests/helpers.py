"""Tiny synthetic motions, rigs, densities and corpora, so that no test needs a data set."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from fractions import Fraction
from functools import cache
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from mapctl import cli, retarget, rotations
from mapctl.features import LAYOUT, GroundPose, encode, integrate_root
from mapctl.motion import Motion
from mapctl.retarget import rigs
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton
from mapctl.terms.trial import Trial
from priors.checkpoints import Card
from priors.lstm_gmm.density import LstmGmmDensity
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig
from priors.training.data import Corpus, compute_feature_statistics
from priors.training.recipes.lstm_gmm import measure_data_limits, select_initial_states

STRIDE = 0.25
"""Swing of the upper legs, radians."""
CADENCE = 0.9
"""Strides a second: with the legs' length they give the speed of `walk`, about 1.2 m/s."""


def generator(seed: int = 0) -> torch.Generator:
    """A seeded generator."""
    return torch.Generator().manual_seed(seed)


def quat_xyzw(rotation_vectors: Tensor) -> Tensor:
    """Quaternions of rotation vectors by scipy, which shares no code with the project."""
    flat = Rotation.from_rotvec(rotation_vectors.reshape(-1, 3).numpy()).as_quat()
    return torch.from_numpy(flat).reshape(*rotation_vectors.shape[:-1], 4)


def walk(frames: int = 90, *, turn_rate: float = 0.0, cadence: float = CADENCE, seed: int = 0, fps: int = 30) -> Motion:
    """A procedural walk: legs and arms swing, knees lift, the lower toe is on the floor."""
    result = _walk(frames, turn_rate, cadence, seed, fps)
    return replace(result, root_position=result.root_position.clone(), local_quat_xyzw=result.local_quat_xyzw.clone())


@cache
def _walk(frames: int, turn_rate: float, cadence: float, seed: int, fps: int) -> Motion:
    """The walk that is copied to whoever asks for it."""
    time = torch.arange(frames, dtype=torch.float64) / fps
    phase = 2 * math.pi * cadence * time
    vectors = _swing(phase, seed)
    heading = turn_rate * time
    vectors[:, 0] = 0.03 * torch.stack([torch.sin(phase), 0 * phase, torch.cos(phase)], -1)
    turn = quat_xyzw(torch.stack([0 * heading, heading, 0 * heading], -1))
    local = quat_xyzw(vectors)
    local[:, 0] = torch.from_numpy((Rotation.from_quat(turn) * Rotation.from_quat(local[:, 0])).as_quat())
    root = _root(heading, speed=0.876 * STRIDE * 2 * math.pi * cadence, fps=fps)
    motion = Motion(CANONICAL, Fraction(fps), root, local)
    toes = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]
    root[:, 1] += TOE_REST_HEIGHT - motion.joint_positions()[:, toes, 1].amin(-1)
    return Motion(CANONICAL, Fraction(fps), root, local)


def walk_through(places_xz, *, headings: float | Tensor = 0.0, fps=30, swing=0.5, wobble=0.0, seed=0):
    """The canonical body at these places; its legs swing once a second and its joints wobble (radians)."""
    frames = len(places_xz)
    time = torch.arange(frames, dtype=torch.float64) / fps
    vectors = wobble * torch.randn(frames, 21, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    for side, sign in (("left", 1), ("right", -1)):
        vectors[:, CANONICAL.index(f"{side}UpperLeg"), 0] += sign * swing * torch.sin(2 * math.pi * time)
    quats = rotations.from_rotation_vector(vectors)
    quats[:, 0] = rotations.about_y(torch.as_tensor(headings, dtype=torch.float64).expand(frames))
    positions = torch.as_tensor(places_xz, dtype=torch.float64)
    root = torch.stack([positions[:, 0], torch.full((frames,), 0.87, dtype=torch.float64), positions[:, 1]], dim=-1)
    return Motion(CANONICAL, Fraction(fps), root, quats)


def go_at(*speeds: float, seconds: int) -> Tensor:
    """Features of the canonical body that goes along +Z, so many seconds at each speed, m/s."""
    way = torch.tensor(speeds).double().repeat_interleave(30 * seconds).cumsum(0) / 30
    return encode(walk_through(torch.stack([0 * way, way], dim=1)))[0].float()


def _swing(phase: Tensor, seed: int) -> Tensor:
    """Rotation vectors (frames, joints, 3) of a gait, with a smooth wobble that the seed draws."""
    offset = 6.3 * torch.rand(CANONICAL.num_joints, 3, generator=generator(seed), dtype=torch.float64)
    vectors = 0.04 * torch.sin(phase[:, None, None] + offset)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = -sign * STRIDE * torch.sin(phase)
        knee = 0.6 * torch.clamp(sign * torch.cos(phase), min=0) ** 2
        for joint, angle in (("UpperLeg", swing), ("LowerLeg", knee), ("Foot", -swing - knee), ("LowerArm", 0 * knee)):
            vectors[:, CANONICAL.index(side + joint), 0] = angle
        vectors[:, CANONICAL.index(side + "UpperArm"), 2] -= sign * 1.2
    return vectors


def _root(heading: Tensor, *, speed: float, fps: int) -> Tensor:
    velocity = speed / fps * torch.stack([torch.sin(heading), 0 * heading, torch.cos(heading)], -1)
    return torch.cat([torch.zeros(1, 3, dtype=torch.float64), velocity[:-1].cumsum(0)])


def walks(count: int = 5, frames: int = 100) -> list[Motion]:
    """Different walks: to the left, straight, to the right; slower and faster."""
    return [walk(frames, turn_rate=0.3 * (k % 3 - 1), cadence=CADENCE * (0.8 + 0.1 * k), seed=k) for k in range(count)]


def random_motion(skeleton: Skeleton, frames: int = 5, *, seed: int = 0, fps: Fraction = Fraction(30)) -> Motion:
    """Every joint in any rotation, the root anywhere."""
    local = torch.from_numpy(Rotation.random(frames * skeleton.num_joints, rng=seed).as_quat())
    root = torch.randn(frames, 3, generator=generator(seed), dtype=torch.float64)
    return Motion(skeleton, fps, root, local.reshape(frames, -1, 4))


def moved(motion: Motion, *, turn: float, shift: tuple[float, float]) -> Motion:
    """The whole motion turned about the vertical through the origin, then shifted along x and z."""
    about = quat_xyzw(torch.tensor([0.0, turn, 0.0], dtype=torch.float64)).expand(motion.num_frames, 4)
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(about, local[:, 0])
    root = rotations.rotate(about, motion.root_position) + torch.tensor([shift[0], 0.0, shift[1]]).double()
    return replace(motion, root_position=root, local_quat_xyzw=local)


def turn_between(a_xyzw: Tensor, b_xyzw: Tensor) -> float:
    """The largest angle between two sets of rotations, radians."""
    first, second = (Rotation.from_quat(q.reshape(-1, 4).numpy()) for q in (a_xyzw, b_xyzw))
    return float((first.inv() * second).magnitude().max())


def bandai_skeleton() -> Skeleton:
    """Canonical bones under Bandai Namco names and joint frames, below a static root."""
    rig = next(r for r in rigs.known_rigs() if r.name == "bandai-namco")
    frames = [Rotation.identity()]
    for name in CANONICAL.names:
        x, y = (torch.tensor(rig.tpose[name][axis], dtype=torch.float64) for axis in ("x", "y"))
        x = x / x.norm()
        y = y / y.norm()
        frames.append(Rotation.from_matrix(torch.stack([x, y, torch.linalg.cross(x, y)], dim=1).numpy()))
    parents = (-1, *(parent + 1 for parent in CANONICAL.parents))
    offsets = [torch.zeros(3, dtype=torch.float64)]
    for offset, parent in zip(CANONICAL.offsets, parents[1:], strict=True):
        offsets.append(torch.from_numpy(frames[parent].inv().apply(offset.numpy())))
    names = ("joint_Root", *(rig.joints[name] for name in CANONICAL.names))
    return Skeleton(names, parents, torch.stack(offsets))


def cmu_skeleton() -> Skeleton:
    """Canonical bones under CMU (Daz) names with bent limbs, one finger, and End Sites for the toes."""
    rig = next(r for r in rigs.known_rigs() if r.name == "cmu-daz")
    kept = [name for name in CANONICAL.names if name in rig.joints]
    names = [rig.joints[name] for name in kept]
    parents = [
        kept.index(CANONICAL.names[p]) if p >= 0 else -1
        for p in (CANONICAL.parents[CANONICAL.index(name)] for name in kept)
    ]
    offsets = torch.stack([CANONICAL.offsets[CANONICAL.index(name)] for name in kept])
    bend = torch.tensor([0.0, -0.017, 0.03], dtype=torch.float64)
    for limb in ("LowerArm", "Hand", "LowerLeg", "Foot"):
        offsets[[kept.index("left" + limb), kept.index("right" + limb)]] += bend
    names.append("lThumb1")
    parents.append(names.index("lHand"))
    offsets = torch.cat([offsets, offsets.new_tensor([[0.03, -0.01, 0.04]])])
    toe = (0.01, -0.07, 0.09)
    return Skeleton(tuple(names), tuple(parents), offsets, {"lFoot": toe, "rFoot": toe, "head": (0.0, 0.2, 0.0)})


@cache
def _features_of_walks(count: int, frames: int) -> list[Tensor]:
    return [encode(motion)[0].float() for motion in walks(count, frames)]


def corpus(count: int = 5, frames: int = 100) -> Corpus:
    """The features of `walks`."""
    clips = _features_of_walks(count, frames)
    return Corpus(tuple(f"walk-{k}.bvh" for k in range(count)), tuple(len(c) for c in clips), torch.cat(clips))


def write_corpus(folder: Path, count: int = 5, frames: int = 80) -> Path:
    """The walks as BVH files of the Bandai Namco rig."""
    folder.mkdir(parents=True, exist_ok=True)
    rigmap = retarget.identify_rig(bandai_skeleton())
    for number, motion in enumerate(walks(count, frames)):
        retarget.from_canonical(motion, rigmap).save(folder / f"walk-{number}.bvh")
    return folder


def tiny_model(
    *,
    width: int = 8,
    components: int = 3,
    seed: int = 0,
    retain: float = 0.9,
    correlated: bool = True,
    dtype: torch.dtype = torch.float32,
) -> LstmGmm:
    """An untrained network with the statistics of the walks: it walks on at their mean pose and speed."""
    mean, std = compute_feature_statistics(corpus().features)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        config = LstmGmmConfig(width=width, components=components, retain=retain, correlated=correlated)
        model = LstmGmm(config, mean=mean, std=std)
    return model.to(dtype).eval().requires_grad_(False)


def tiny_density(
    *, width: int = 8, components: int = 3, seed: int = 0, starts: int = 4, dtype: torch.dtype = torch.float32
) -> LstmGmmDensity:
    """The network as the solver takes it, by the compiled kernels where it is float32, with starts from the walks."""
    model = tiny_model(width=width, components=components, seed=seed)
    data = corpus()
    found = select_initial_states(model, data, count=starts, generator=generator(seed))
    limits, names = measure_data_limits(data), {"starts": list(found.names)}
    shape, shown = model.config.as_card(), asdict(limits)
    card = Card("lstm-gmm", shape, licence="none", data=names, abilities=shown)
    fast = dtype is torch.float32
    density = LstmGmmDensity("tiny", model.to(dtype), found, limits, card, use_fast=fast)
    if dtype is not torch.float32:
        for part in ("last_frame", "hidden", "cell"):
            object.__setattr__(found.state, part, getattr(found.state, part).to(dtype))
    return density


def walking_trial(frames: int) -> Trial:
    """So many frames of a walk, no toe planted, and the two before them."""
    motion = walk(frames + 2)
    vectors, start = encode(motion)
    ground, heading = integrate_root(vectors[:2], start)
    bits = torch.zeros(1, frames, 2, dtype=torch.bool)
    position = GroundPose(ground[-1], heading[-1])
    return Trial(vectors[None, 2:], position, contacts=bits, before=motion.joint_positions()[:2])


def noise(batch: int, frames: int, *, seed: int = 0, dtype: torch.dtype = torch.float32) -> Float[Tensor, "b f c"]:
    """Latents of a rollout."""
    return torch.randn(batch, frames, LAYOUT.continuous, generator=generator(seed), dtype=torch.float64).to(dtype)


def finite_difference(function, at: Tensor, direction: Tensor, *, step: float = 1e-6) -> float:
    """Central difference of a scalar function along a direction."""
    return float((function(at + step * direction) - function(at - step * direction)) / (2 * step))


def run(*words: object) -> int:
    """The command line in this process; its exit status."""
    return cli.main([str(word) for word in words])


class Killed(Exception):
    """Exception that ends a training run between two steps."""


@contextmanager
def killing(settings: type, number: int) -> Iterator[None]:
    """Kills the training with these settings when its step of this number is begun."""
    make = settings.make_trainer

    def make_stopping(self, parts):
        trainer = make(self, parts)
        whole = trainer.train_step

        def train_step():
            if trainer.step == number:
                raise Killed
            return whole()

        trainer.train_step = train_step
        return trainer

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "make_trainer", make_stopping)
        with pytest.raises(Killed):
            yield


KEYS = """
body = "in.bvh"
[[key]]
frame = 0
[[key]]
seconds = 0.5
reach = { Hand_L = [0.4, 1.2, 0.8] }
[[key]]
frame = 22
pose = "other.bvh"
pose_frame = 20
root_only = true
[[key]]
frame = 40
pose_frame = 40
place = [0.3, 1.5]
"""
"""Keys of every kind for `tween`, on the rig of in.bvh."""


def make_smpl_parameters(frames: int, *, joints: int = 21, seed: int = 0) -> dict[str, Tensor]:
    """Parameters of a standing body, Y up, as estimators from video save them: `joints` of `body_pose`."""
    random = generator(seed)

    def draw(size: int, spread: float) -> Tensor:
        return spread * torch.randn(frames, size, generator=random)

    return {
        "global_orient": draw(3, 0.2),
        "body_pose": draw(3 * joints, 0.2),
        "transl": draw(3, 1.0),
        "betas": draw(10, 1.0)[:1].repeat(frames, 1),
    }
