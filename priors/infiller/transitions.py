"""The recurrent transition network of Harvey and Pal 2018, with which Zhou et al. 2020 compare (section 4.6, table 4).

An LSTM sees the frames before a gap one after the other, and at each of them the pose it is to arrive at, how far off
that is and how long is left; from the last on it goes by what it made itself. It has no notion of the whole gap, and of
no key but the next. Motion is seen from the hips' place and heading before the gap, as there.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mapctl import rotations
from mapctl.inbetweening import PositionImage
from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL

PAST_FRAMES, FRAMES_AFTER = 20, 2
"""Frames before a gap, and of the key behind it, that the network is given (30 fps)."""
_PLACES = 3 * CANONICAL.num_joints
_PLACE_UNIT, _STEP_UNIT, _OFFSET_UNIT = 0.3, 0.03, 0.6  # metres that are 1 to the network; steps in a frame
_LEFT_SCALES = (4.0, 16.0, 64.0)  # frames over which what is left of a gap is told
_HIPS_HEIGHT = 0.9  # metres
_MAX_STEP, _MAX_HEIGHT, _MAX_REACH = 0.35, 3.0, 1.5  # metres: of the hips in a frame, of them, of joints from them


class TransitionNetwork(nn.Module):
    """Three encoders, an LSTM, and a decoder that changes the present frame into the next."""

    def __init__(self, width: int):
        """`width` is that of the encoders and of the memory."""
        super().__init__()
        self.state = _encoder(2 * _PLACES + 2, width)
        self.target = _encoder(2 * _PLACES + 1, width)
        self.offset = _encoder(_PLACES + len(_LEFT_SCALES), width)
        self.begin = nn.Linear(width, 2 * width)
        self.memory = nn.LSTMCell(3 * width, width)
        self.decode = nn.Sequential(
            nn.Linear(width, width), nn.LeakyReLU(0.2), nn.Linear(width, width // 2), nn.LeakyReLU(0.2)
        )
        self.change = nn.Linear(width // 2, _PLACES + 2)
        for parameter in self.change.parameters():
            nn.init.zeros_(parameter)

    def forward(self, task: "_Transitions") -> tuple[Float[Tensor, "gaps made joints 3"], Float[Tensor, "gaps made 2"]]:
        """Make the frames of gaps and, as if they were not known, the `FRAMES_AFTER` behind them; also contact logits.
        A gap that is shorter than the longest goes on behind its end, with nothing left."""
        target = self.target(task.describe_target())
        memory = cell = torch.zeros(len(target), target.shape[-1]).to(target)
        place, before, contacts = task.past[:, 0], task.past[:, 0], task.past_contacts[:, 0]
        made, planted = [], []
        for frame in range(PAST_FRAMES + task.frames - 1):
            step = place - before
            state = self.state(torch.cat([_see_pose(place), (step / _STEP_UNIT).flatten(1), contacts], dim=-1))
            first = task.past_frames[:, None] == PAST_FRAMES - frame
            begun, begun_cell = self.begin(state).chunk(2, dim=-1)
            memory, cell = torch.where(first, begun.tanh(), memory), torch.where(first, begun_cell, cell)
            offset = self.offset(task.describe_offset(place, frame))
            memory, cell = self.memory(torch.cat([state, target, offset], dim=-1), (memory, cell))
            if frame + 1 < PAST_FRAMES:
                before, place, contacts = place, task.past[:, frame + 1], task.past_contacts[:, frame + 1]
                continue
            change = self.change(self.decode(memory))
            logits = 4 * change[:, _PLACES:]
            told = _STEP_UNIT * change[:, :_PLACES].unflatten(-1, (-1, 3))
            before, place = place, _go_on(place, step, told)
            contacts = logits.sigmoid()
            made.append(place)
            planted.append(logits)
        return torch.stack(made, dim=1), torch.stack(planted, dim=1)


@dataclass(frozen=True, eq=False)
class _Transitions:
    """Gaps to be filled, one in a row, in the frame of reference of the hips before each of them."""

    past: Float[Tensor, "gaps past joints 3"]
    """Places in the frames before; where there are only `past_frames`, the first of these stands for all before it."""
    past_contacts: Float[Tensor, "gaps past 2"]
    """Planted toes, 0 to 1."""
    past_frames: Int[Tensor, " gaps"]
    """How many of them there are, 1 or more."""
    target: Float[Tensor, "gaps joints 3"]
    """Places in the first frame behind the gap."""
    target_step: Float[Tensor, "gaps joints 3"]
    """What follows it by the next, 0 where that is not known."""
    step_known: Bool[Tensor, " gaps"]
    """Whether it is."""
    lengths: Int[Tensor, " gaps"]
    """Frames of each gap."""

    @property
    def frames(self) -> int:
        """Frames that are made."""
        return int(self.lengths.max()) + FRAMES_AFTER

    def describe_target(self) -> Float[Tensor, "gaps size"]:
        """Encode the pose to arrive at and the pace there."""
        step = (self.target_step / _STEP_UNIT).flatten(1)
        return torch.cat([_see_pose(self.target), step, self.step_known[:, None].to(step)], dim=-1)

    def describe_offset(self, place: Float[Tensor, "gaps joints 3"], frame: int) -> Float[Tensor, "gaps size"]:
        """Encode how far off that is in space and in time; `frame` counts from the first of the past."""
        left = (self.lengths - (frame - PAST_FRAMES)).clamp_min(0)[:, None]
        times = [torch.exp(-left / scale) for scale in _LEFT_SCALES]
        return torch.cat([((self.target - place) / _OFFSET_UNIT).flatten(1), *(each.to(place) for each in times)], -1)


def fill_transitions(
    network: TransitionNetwork,
    image: PositionImage,
    shown: Float[Tensor, "batch frames joints 3"],
    *,
    keep: bool = True,
) -> tuple[Float[Tensor, "batch frames joints 3"], Float[Tensor, "batch frames 2"]]:
    """Fill the gaps of an image, whose places are `shown` relative to its reference, from left to right; also contact
    logits. Only runs of frames between two that are known are filled, where joints that are never known do not count;
    elsewhere `shown` stays. Without `keep` the frames behind gaps are not as they are known but as they were made."""
    world, contacts = image.to_world(shown), image.contacts
    logits, filled = torch.zeros_like(contacts), torch.zeros_like(image.present)
    whole = (image.known | ~image.ever_known[:, None]).all(dim=-1) & image.known.any(dim=-1)
    arrivals = []
    for gaps in _list_gaps(whole, image.present):
        task, (ground, heading) = _set_task(image, world, contacts, whole, gaps)
        places, guessed = network(task)
        places = _turn(places, heading) + rotations.lift_ground(ground)[:, None, None]
        frame = gaps.starts[:, None] + torch.arange(task.frames)
        row, left = gaps.rows[:, None].expand_as(frame), gaps.stops[:, None] - frame
        inside, after = left > 0, (left <= 0) & (left > -FRAMES_AFTER) & (frame < world.shape[1])
        at = row[inside], frame[inside]
        world, logits = world.index_put(at, places[inside].to(world)), logits.index_put(at, guessed[inside].to(logits))
        contacts = contacts.index_put(at, guessed[inside].detach().sigmoid().to(contacts))
        filled = filled.index_put(at, torch.ones_like(at[0], dtype=torch.bool))
        arrivals.append((row[after], frame[after], places[after].to(world)))
    made = filled[..., None] & ~image.known
    if not keep:
        for row, frame, places in arrivals:
            world, made = world.index_put((row, frame), places), made.index_put((row, frame), torch.tensor(True))
    return torch.where(made[..., None], image.from_world(world), shown), logits


@dataclass(frozen=True, eq=False)
class _Gaps:
    """At most one gap of each motion of a batch, with known frames on both sides."""

    rows: Int[Tensor, " gaps"]
    starts: Int[Tensor, " gaps"]
    stops: Int[Tensor, " gaps"]
    firsts: Int[Tensor, " gaps"]  # frame from which on the motion is known or made


def _list_gaps(whole: Bool[Tensor, "batch frames"], present: Bool[Tensor, "batch frames"]) -> list[_Gaps]:
    """List the first gaps of all motions, the second ones, and so on."""
    found: dict[int, list[tuple[int, int, int, int]]] = {}
    told: dict[int, int] = {}
    for row, start, stop in true_intervals((~whole & present).T):
        if start > 0 and stop < whole.shape[1] and bool(whole[row, start - 1] & whole[row, stop]):
            first = int(whole[row].to(torch.uint8).argmax())
            number = told[row] = told.get(row, -1) + 1
            found.setdefault(number, []).append((row, start, stop, first))
    return [_Gaps(*torch.tensor(each).T) for each in found.values()]


def _set_task(
    image: PositionImage, world: Tensor, contacts: Tensor, whole: Tensor, gaps: _Gaps
) -> tuple[_Transitions, tuple[Tensor, Tensor]]:
    """Return gaps as the network takes them; and the place and heading, in the world, that they are seen from."""
    rows, last = gaps.rows, gaps.starts - 1
    index = (gaps.starts[:, None] + torch.arange(-PAST_FRAMES, 0)).maximum(gaps.firsts[:, None])
    ground, heading = world[rows, last, 0][:, ::2].detach(), image.heading[rows, last]
    origin = rotations.lift_ground(ground)[:, None, None]
    past = _turn(world[rows[:, None], index].detach() - origin, -heading)
    following = (gaps.stops + 1).clamp(max=world.shape[1] - 1)
    key = _turn(torch.stack([world[rows, gaps.stops], world[rows, following]], dim=1) - origin, -heading)
    told = whole[rows, following] & (following > gaps.stops)
    step = torch.where(told[:, None, None], key[:, 1] - key[:, 0], 0.0)
    have = (gaps.starts - gaps.firsts).clamp(max=PAST_FRAMES)
    task = _Transitions(past, contacts[rows[:, None], index], have, key[:, 0], step, told, gaps.stops - gaps.starts)
    return task, (ground, heading)


def _turn(places: Float[Tensor, "gaps frames joints 3"], angle: Float[Tensor, " gaps"]) -> Tensor:
    return rotations.rotate_about_y(places, angle[:, None, None])


def _go_on(
    place: Float[Tensor, "gaps joints 3"], step: Float[Tensor, "gaps joints 3"], told: Float[Tensor, "gaps joints 3"]
) -> Float[Tensor, "gaps joints 3"]:
    """Return the next places: hips at their pace and other joints about them, but for what is told. Neither leaves what
    a body can do, or errors would grow without an end in gaps longer than those of the training."""
    hips = place[:, :1] + (step[:, :1] + told[:, :1]).clamp(-_MAX_STEP, _MAX_STEP)
    height = hips[..., 1:2].clamp(0.0, _MAX_HEIGHT)
    hips = torch.cat([hips[..., :1], height, hips[..., 2:]], dim=-1)
    about = (place[:, 1:] - place[:, :1] + told[:, 1:]).clamp(-_MAX_REACH, _MAX_REACH)
    return torch.cat([hips, hips + about], dim=1)


def _see_pose(place: Float[Tensor, "gaps joints 3"]) -> Float[Tensor, "gaps size"]:
    """See a pose from its hips; their own place tells how high they are."""
    hips = place[:, :1]
    up = torch.cat(
        [torch.zeros_like(hips[..., :1]), hips[..., 1:2] - _HIPS_HEIGHT, torch.zeros_like(hips[..., :1])], -1
    )
    return (torch.cat([up, place[:, 1:] - hips], dim=1) / _PLACE_UNIT).flatten(1)


def _encoder(inputs: int, width: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, width), nn.LeakyReLU(0.2), nn.Linear(width, width), nn.LeakyReLU(0.2))
