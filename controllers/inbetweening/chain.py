"""One long motion through short pieces of many clips, the gaps between filled in (Kaufmann et al. 2020, figure 1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.solution import InbetweenSolution
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.terms import Term

_VELOCITY_FRAMES = 5  # frames over which the way on at a piece's end is told


@dataclass(frozen=True)
class ChainSettings:
    """How long pieces and gaps are, frames at the prior's rate."""

    piece: int = 40
    """From the middle of every clip; a shorter one is taken whole."""
    gap: tuple[int, int] = (50, 100)
    """Between two pieces, drawn evenly from the first up to the second."""

    def __post_init__(self):
        if self.piece < 2 or not 1 <= self.gap[0] <= self.gap[1] <= 900:
            raise RequestError(f"pieces need 2 frames or more and gaps 1 to 900, got {self.piece} and {self.gap}")


def chain(
    clips: Sequence[Motion],
    inbetweener: Inbetweener,
    *,
    generator: torch.Generator,
    settings: ChainSettings | None = None,
    filling: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
) -> InbetweenSolution:
    """Chain pieces of clips to a motion on the first clip's rig at PRIOR_FPS. RequestError for fewer than two clips.

    Each piece goes where the one before leads: on in its direction for half of the gap, then in the next one's. The
    generator draws the gaps' lengths, then what the in-betweener draws.
    """
    settings = settings or ChainSettings()
    if len(clips) < 2:
        raise RequestError(f"a chain needs at least two clips, got {len(clips)}")
    body, notes = RiggedCharacter.of(clips[0])[1], []
    whole: Motion | None = None
    masks: list[Mask] = []
    for clip in clips:
        piece, missed = _cut_piece(clip, body, settings.piece)
        notes += missed
        if whole is None:
            whole = piece
            continue
        low, high = settings.gap
        gap = int(torch.randint(low, high + 1, (), generator=generator))
        masks.append(Mask(ALL, whole.num_frames, whole.num_frames + gap))
        piece = _align_to_predecessor(whole, piece, gap)
        held = torch.full((gap,), whole.num_frames - 1)
        whole = whole.join(
            replace(whole, root_position=whole.root_position[held], local_quat_xyzw=whole.local_quat_xyzw[held])
        ).join(piece)
    assert whole is not None, "there are clips"
    done = infill(
        body.on_rig(whole), inbetweener, masks, settings=filling, densities=densities, terms=terms, generator=generator
    )
    return replace(done, status=done.status.with_notes(notes))


def _cut_piece(clip: Motion, body: RiggedCharacter, frames: int) -> tuple[Motion, tuple[str, ...]]:
    """Frames from a clip's middle, on the bones of the body and on its floor, and what of them could not be kept."""
    carried = retarget_motion(clip, body)
    motion = carried.motion.resample(PRIOR_FPS)
    count = min(frames, motion.num_frames)
    start = (motion.num_frames - count) // 2
    return replace(motion.slice(start, start + count), source=None), carried.notes


def _align_to_predecessor(before: Motion, piece: Motion, gap: int) -> Motion:
    """The piece, moved and turned to where the motion before it comes after so many frames."""
    facing = heading(before.local_quat_xyzw[-1:, 0])
    turned = _rotate_about_vertical(piece, facing - heading(piece.local_quat_xyzw[:1, 0]))
    way = (
        (gap + 1)
        / 2
        * (
            _compute_mean_velocity(before.root_position[-_VELOCITY_FRAMES:])
            + _compute_mean_velocity(turned.root_position[:_VELOCITY_FRAMES])
        )
    )
    aim = before.root_position[-1] + way
    moved = aim - turned.root_position[0]
    moved[1] = 0
    return replace(turned, root_position=turned.root_position + moved)


def _compute_mean_velocity(places: Tensor) -> Tensor:
    """Mean way of a frame."""
    return (places[-1] - places[0]) / max(1, len(places) - 1)


def _rotate_about_vertical(motion: Motion, angle: Tensor) -> Motion:
    """About the vertical through the origin."""
    turn = rotations.about_y(angle).expand(motion.num_frames, 4)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    return replace(motion, local_quat_xyzw=quats, root_position=rotations.rotate(turn, motion.root_position))
