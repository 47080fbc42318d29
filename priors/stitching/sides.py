"""Both sides of a transition, walked towards each other (Ren et al. 2024, section 3.2 and Eq. 3).

Both step at once, each towards the other's latest frame, so that one call serves both; the paper has them in turn, as
here with `StitcherConfig.printed`. Once they have met, each goes on towards the true far end for the frames of the
overlap. Features of the backward side are those of the motion run backwards (`mapctl.features.reversed_features`).

Two sides joined to one transition: their overlap blended, and what they disagree on in place spread over all of it.

Ren et al. 2024, section 3.2, blend the overlap alone. Ten centimetres between two sides blended over eight frames would
slide both feet; spread over the whole way they are a slightly longer or shorter walk. `Sides.spread` tells whether.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import LAYOUT, GroundPose
from mapctl.kinematics.joint_places import place_joints
from mapctl.pose import BodyPose
from mapctl.runtime.stepwise import StepwiseWork
from mapctl.skeleton import CANONICAL
from priors.stitching.network import POSE, Gaussian, Memory, Situation, StitcherNetwork

Frame = tuple[Float[Tensor, "2 batch size"], Float[Tensor, "2 batch pose"], Float[Tensor, "2 batch"]]
"""Features, the change of pose that led to them, and 1 where change, step, turn and contacts are known."""
_OVERLAP_SHARE, _MOST_OVERLAP = 8, 6  # K is so much of the frames, and no more


@dataclass(frozen=True, eq=False)
class Ends:
    """What is known of a transition: its two ends, and frames before the one and after the other."""

    features: Float[Tensor, "2 batch context size"]
    """Frames up to each side's end, which is the last, in the side's own sense of time."""
    present: Float[Tensor, "2 batch context"]
    """1 where there is such a frame; the last always is, and those before it without a gap."""
    place: Float[Tensor, "batch 2"]
    """Where the second end is over the ground, seen from the first in its heading frame, metres."""
    turn: Float[Tensor, "batch"]
    """By how much its heading is another, radians."""

    @property
    def paced(self) -> Float[Tensor, "2 batch"]:
        """1 where step, turn and contacts of the end are known: not of a bare pose, without a frame before it."""
        return self.present[:, :, -2] if self.present.shape[2] > 1 else torch.zeros_like(self.present[:, :, 0])


@runtime_checkable
class Latents(Protocol):
    """Where latents come from."""

    def share(self, prior: Gaussian, seen: Float[Tensor, "2 batch seen"]) -> Float[Tensor, "batch shared"]:
        """What both sides share over the transition."""
        ...

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        """A frame's, of both sides."""
        ...


@dataclass(frozen=True, eq=False)
class Sides:
    """What both sides made, each from its own end on."""

    frames: int
    """From one pose to the other."""
    features: Float[Tensor, "sides batch made size"]
    """In each side's own sense of time; contacts are probabilities."""
    logits: Float[Tensor, "sides batch made 2"]
    """Of the contacts."""
    place: Float[Tensor, "sides batch made 2"]
    """Of the hips over the ground, metres, seen from the first end."""
    heading: Float[Tensor, "sides batch made"]
    """Of the hips, radians, likewise."""
    phases: Float[Tensor, "sides batch made 4"]
    """Of the frames made."""
    shares: Float[Tensor, "sides batch made experts"]
    """Of the experts."""
    at_ends: Float[Tensor, "sides batch 4"]
    """Phases of the ends themselves."""
    spread: bool = True
    """Whether what the sides disagree on in place is spread over the whole way, before the overlap is blended."""

    @property
    def overlap(self) -> tuple[int, int]:
        """First and last frame, counted from the first pose, that both sides made; none if the first is the later."""
        made = self.features.shape[2]
        return self.frames - made, made

    def place_joints(self) -> Float[Tensor, "sides batch made joints 3"]:
        """Place the joints, metres, seen from the first end."""
        shape = self.features.shape[:2]
        return place_joints(
            self.features.flatten(0, 1), self.place.flatten(0, 1), self.heading.flatten(0, 1), CANONICAL
        ).unflatten(0, shape)


def count_made(network: StitcherNetwork, frames: int) -> int:
    """Count the frames that each side of a transition makes: up to the middle and K beyond it, an eighth of the
    transition and 6 at most, which the paper leaves open; one at least is made by both."""
    beyond = min(round(frames / _OVERLAP_SHARE), _MOST_OVERLAP)
    return min(max(frames // 2 + beyond, (frames + 1) // 2), frames - 1)


def walk_sides(network: StitcherNetwork, ends: Ends, frames: int, latents: Latents) -> Sides:
    """Walk both sides of a transition of so many frames from pose to pose until they overlap."""
    return StepwiseWork(walk_stepwise(network, ends, frames, latents)).finish()


def walk_stepwise(network: StitcherNetwork, ends: Ends, frames: int, latents: Latents) -> Generator[None, None, Sides]:
    """Walk both sides as `walk_sides`, a frame at a time."""
    made = count_made(network, frames)
    memory, shared, at = yield from _enter(network, ends, frames, latents)
    walker = _Walker(network, ends, frames, latents, shared, at)
    standing, rows = _Standing(*_pick_end(ends), at, memory), []
    for step in range(made):
        left = frames - 2 * step
        after, row = walker.step(standing, step, left)
        if network.config.printed:
            # In turn (Eq. 3): the backward side goes to the frame that the forward side has just made.
            last, again = walker.step(after.merge(standing), step, left - 1)
            after = after.merge(last)
            row = tuple(_take_sides(*pair) for pair in zip(row, again, strict=True))
        standing = after
        yield
        rows.append((standing.now, row[0], standing.at.position_xz, standing.at.heading, standing.memory.phase, row[1]))
    features, logits, places, headings, phases, shares = (
        torch.stack(column, dim=2) for column in zip(*rows, strict=True)
    )
    spread = not network.config.printed
    return Sides(frames, features, logits, places, headings, phases, shares, memory.phase, spread)


@dataclass(frozen=True, eq=False)
class _Standing:
    """Where both sides are."""

    now: Float[Tensor, "2 batch size"]
    change: Float[Tensor, "2 batch pose"]
    paced: Float[Tensor, "2 batch"]
    at: GroundPose
    memory: Memory

    def merge(self, backward: "_Standing") -> "_Standing":
        """Return the forward side of this and the backward side of another."""
        forward = torch.tensor([1.0, 0.0])[:, None].expand_as(self.paced)
        position = _take_sides(self.at.position_xz, backward.at.position_xz)
        return _Standing(
            _take_sides(self.now, backward.now),
            _take_sides(self.change, backward.change),
            _take_sides(self.paced, backward.paced),
            GroundPose(position, _take_sides(self.at.heading, backward.at.heading)),
            self.memory.keep(backward.memory, forward),
        )


@dataclass(frozen=True, eq=False)
class _Walker:
    """Steps of both sides at once."""

    network: StitcherNetwork
    ends: Ends
    frames: int
    latents: Latents
    shared: Float[Tensor, "batch shared"]
    far_at: GroundPose

    def step(self, standing: _Standing, step: int, left: int) -> tuple[_Standing, tuple[Tensor, ...]]:
        """Take one step of each side towards the other, `left` frames away, or towards the far end once they have met;
        also returns the contacts' logits and the experts' shares."""
        network, memory, paced = self.network, standing.memory, standing.paced
        here = standing.now, standing.change, paced
        aligned = left >= 1
        target, target_at = (here, standing.at) if aligned else (_pick_end(self.ends), self.far_at)
        situation = _look(here, standing.at, target, target_at, float(left if aligned else self.frames - step))
        seen = network.embed(situation)
        arrived = torch.full_like(paced, self._arrive(step, left if aligned else self.frames - step))
        encoded, encoder, prior = network.encode(seen, situation, memory, arrived)
        own = self.latents.own(prior, encoded, step)
        latent = torch.cat([self.shared.expand(2, -1, -1), own], dim=-1)
        now, logits, memory, share = network.decode(seen, encoded, latent, situation, memory, encoder)
        change, at = (now - standing.now)[..., POSE], standing.at.displace(*_pick_pace(now))
        return _Standing(now, change, torch.ones_like(paced), at, memory), (logits, share)

    def _arrive(self, step: int, left: int) -> float:
        """Return the share of the distribution on arrival: of the way to the target in force, or as printed in Eq. 2,
        which comes to the end in the middle and once more beyond it."""
        if not self.network.config.printed:
            return step / (step + left)
        middle = max(1, self.frames // 2)
        return step / middle if step < middle else min(1.0, step / max(1, count_made(self.network, self.frames)))


def reverse_sense(features: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch size"]:
    """Return single frames as who walks the other way reads them: the step and turn that led there lead on from
    there."""
    step, turn = _pick_pace(features)
    back = -rotations.rotate_ground(step, -turn)
    return torch.cat([back, -turn[..., None], features[..., LAYOUT.slices["root_height"].start :]], dim=-1)


def _enter(
    network: StitcherNetwork, ends: Ends, frames: int, latents: Latents
) -> Generator[None, None, tuple[Memory, Float[Tensor, "batch shared"], GroundPose]]:
    """Walk through the frames before each end; returns the memory there, what is shared and where the ends are."""
    context = ends.features.shape[2]
    zero = torch.zeros_like(ends.place)
    at = GroundPose(torch.stack([zero, ends.place]), torch.stack([zero[:, 0], ends.turn]))
    grounds = [at]
    for number in range(context - 1, 0, -1):
        grounds.insert(0, grounds[0].before(*_pick_pace(ends.features[:, :, number])))
    end = _pick_end(ends)

    def look(number: int) -> Situation:
        left = float(frames + context - 1 - number)
        return _look(_pick_frame(ends, number), grounds[number], end, at, left)

    first = network.embed(look(context - 1))
    shared = latents.share(network.tell_shared(first), first)
    memory, before = network.begin(first), torch.zeros_like(ends.present[:, :, 0])
    for number in range(context - 1):
        there = ends.present[:, :, number]
        situation = look(number)
        seen = network.embed(situation)
        memory = network.begin(seen).keep(memory, 1 - before)
        encoded, encoder, prior = network.encode(seen, situation, memory, torch.zeros_like(there))
        latent = torch.cat([shared.expand(2, -1, -1), prior.mean], dim=-1)
        after = network.decode(seen, encoded, latent, situation, memory, encoder)[2]
        memory, before = after.keep(memory, there), there
        yield
    if context > 1:
        memory = network.begin(first).keep(memory, 1 - before)
    return memory, shared, at


def _take_sides(forward: Float[Tensor, "2 *shape"], backward: Float[Tensor, "2 *shape"]) -> Float[Tensor, "2 *shape"]:
    """Take the forward side of the one and the backward side of the other."""
    return torch.stack([forward[0], backward[1]])


def _pick_end(ends: Ends) -> Frame:
    return _pick_frame(ends, ends.features.shape[2] - 1)


def _pick_frame(ends: Ends, number: int) -> Frame:
    """Pick a frame, its change of pose since the frame before, and whether that one is known."""
    now = ends.features[:, :, number]
    if number == 0:
        return now, torch.zeros_like(now[..., POSE]), torch.zeros_like(ends.present[:, :, 0])
    return now, (now - ends.features[:, :, number - 1])[..., POSE], ends.present[:, :, number - 1]


def _look(now: Frame, at: GroundPose, target: Frame, target_at: GroundPose, left: float) -> Situation:
    """Tell each side what it knows: of the other it sees the frame given for it."""
    away = target_at.position_xz.flip(0) - at.position_xz
    features, change, paced = now
    aim, aim_change, aim_paced = target
    return Situation(
        features=features,
        change=change,
        paced=paced,
        target=reverse_sense(aim.flip(0)),
        target_change=-aim_change.flip(0),
        target_paced=aim_paced.flip(0),
        place=rotations.rotate_ground(away, -at.heading),
        turn=rotations.wrap_angle(target_at.heading.flip(0) - at.heading),
        left=torch.full_like(paced, left),
    )


def _pick_pace(features: Float[Tensor, "*batch size"]) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    return LAYOUT.pick(features, "root_displacement_heading"), LAYOUT.pick(features, "heading_change")[..., 0]


@dataclass(frozen=True, eq=False)
class Joined:
    """The frames between two poses, seen from the first."""

    root_position: Float[Tensor, "batch frames 3"]
    """Of the hips, metres."""
    quats: Float[Tensor, "batch frames joints 4"]
    """Local rotations."""
    contacts: Float[Tensor, "batch frames 2"]
    """Logits of planted toes."""
    apart: Float[Tensor, " batch"]
    """Mean distance of the two sides' joints in the middle of their overlap before they are joined, metres (MMPE)."""

    @property
    def finite(self) -> Bool[Tensor, " batch"]:
        """Whether all numbers of a motion are finite."""
        return self.root_position.isfinite().flatten(1).all(dim=1) & self.quats.isfinite().flatten(1).all(dim=1)

    def row(self, number: int) -> "Joined":
        """Return one motion, as a batch of one."""
        part = slice(number, number + 1)
        return Joined(self.root_position[part], self.quats[part], self.contacts[part], self.apart[part])


def join_sides(sides: Sides) -> Joined:
    """Join the sides of a transition of two frames or more."""
    between, made = sides.frames - 1, sides.features.shape[2]
    first, last = sides.overlap
    if first > last:
        raise ValueError("sides that have no frame in common cannot be joined")
    bodies = [_place_body(sides, side) for side in (0, 1)]
    seam = (first + last) // 2
    index = [seam - 1, between - seam]  # the same frame, as each side counts
    pairs = [body.slice(at, at + 1) for body, at in zip(bodies, index, strict=True)]
    apart = (pairs[0].joints_world() - pairs[1].joints_world()).norm(dim=-1).mean(dim=(1, 2))
    miss = (pairs[1].root_position - pairs[0].root_position)[:, 0, ::2]
    twist = rotations.wrap_angle(pairs[1].heading - pairs[0].heading)[:, 0]
    rows = []
    for side, body in enumerate(bodies):
        frame = torch.arange(1, made + 1) if side == 0 else torch.arange(made, 0, -1)
        share = _ease((frame / (sides.frames / 2)).clamp_max(1)) * (0.5 if side == 0 else -0.5) * sides.spread
        order = slice(None) if side == 0 else torch.arange(made - 1, -1, -1)
        root, quats = body.root_position[:, order], body.local_quat_xyzw[:, order]
        heading = rotations.about_y(share * twist[:, None])
        hips = rotations.multiply(heading, quats[..., 0, :])
        offset = rotations.lift_ground(share[:, None] * miss[:, None])
        quats = torch.cat([hips[..., None, :], quats[..., 1:, :]], dim=-2)
        rows.append((root + offset, quats, sides.logits[side][:, order]))
    root, quats, logits = (_blend(one, other, between, first, last) for one, other in zip(*rows, strict=True))
    return Joined(root, quats, logits, apart)


def _place_body(sides: Sides, side: int) -> BodyPose:
    """The poses of a side in the world of the first end, in its own order."""
    features, ground = sides.features[side], sides.place[side]
    height = LAYOUT.pick(features, "root_height")
    root = torch.cat([ground[..., :1], height, ground[..., 1:]], dim=-1)
    tilt, joints = LAYOUT.pick(features, "root_tilt"), LAYOUT.pick(features, "joint_rotations")
    return BodyPose(root, sides.heading[side], tilt, joints.unflatten(-1, (-1, 3)))


def _ease(share: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """From 0 to 1 without a leap of speed at either end."""
    return share * share * (3 - 2 * share)


def _blend(one: Tensor, other: Tensor, between: int, first: int, last: int) -> Tensor:
    """Take the first side's frames up to the overlap, the second's after it, and a blend between that goes from one to
    the other evenly; quaternions on the shortest arc."""
    made = one.shape[1]
    count = last - first + 1
    share = torch.arange(1, count + 1, dtype=one.dtype) / (count + 1)
    a, b = one[:, first - 1 : last], other[:, :count]
    if one.ndim == 4:
        mixed = rotations.slerp(a, b, share[None, :, None].expand(a.shape[:-1]))
    else:
        mixed = torch.lerp(a, b, share[None, :, None])
    assert made + (made - count) == between
    return torch.cat([one[:, : first - 1], mixed, other[:, count:]], dim=1)
