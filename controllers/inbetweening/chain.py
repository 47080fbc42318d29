"""One long motion through short pieces of many clips, the gaps between infilled (Kaufmann et al. 2020, figure 1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.solution import InbetweenSolution
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.kinematics import heading
from mapctl.kinematics.placing import rotate_about_vertical
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.terms import Term

_VELOCITY_FRAMES = 5  # frames over which the velocity at a piece's end is estimated


@dataclass(frozen=True)
class ChainSettings:
    """Lengths of pieces and gaps, frames at the prior's rate."""

    piece: int = 40
    """Frames of a piece, from the middle of every clip; a shorter clip is taken whole."""
    gap: tuple[int, int] = (50, 100)
    """Fewest and most frames of a gap, sampled uniformly."""

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
    rig: Rig | None = None,
) -> InbetweenSolution:
    """Chain pieces of clips to a motion on the first clip's rig at PRIOR_FPS. RequestError for fewer than two clips.

    Each piece is aligned to the one before: the trajectory goes on at its velocity for half of the gap, then at the
    next one's. The generator samples the gaps' lengths, then is the in-betweener's. `rig` is that of all clips, where
    it is not the one that would be recognised.
    """
    settings = settings or ChainSettings()
    if len(clips) < 2:
        raise RequestError(f"a chain needs at least two clips, got {len(clips)}")
    body, notes = RiggedCharacter.of(clips[0], rig)[1], []
    whole: Motion | None = None
    masks: list[Mask] = []
    for clip in clips:
        piece, piece_notes = _cut_piece(clip, body, settings.piece, rig)
        notes += piece_notes
        if whole is None:
            whole = piece
            continue
        low, high = settings.gap
        gap = int(torch.randint(low, high + 1, (), generator=generator))
        masks.append(Mask(ALL, whole.num_frames, whole.num_frames + gap))
        piece = _align_to_predecessor(whole, piece, gap)
        last = torch.full((gap,), whole.num_frames - 1)
        whole = whole.join(
            replace(whole, root_position=whole.root_position[last], local_quat_xyzw=whole.local_quat_xyzw[last])
        ).join(piece)
    assert whole is not None, "there are clips"
    done = infill(
        body.on_rig(whole),
        inbetweener,
        masks,
        settings=filling,
        densities=densities,
        terms=terms,
        rig=rig,
        generator=generator,
    )
    return replace(done, status=done.status.with_notes(notes))


def _cut_piece(clip: Motion, body: RiggedCharacter, frames: int, rig: Rig | None) -> tuple[Motion, tuple[str, ...]]:
    """Cut frames from a clip's middle, retargeted to the body and its floor; and note what could not be kept."""
    retargeted = retarget_motion(clip, body, rig)
    motion = retargeted.motion.resample(PRIOR_FPS)
    count = min(frames, motion.num_frames)
    start = (motion.num_frames - count) // 2
    return replace(motion.slice(start, start + count), source=None), retargeted.notes


def _align_to_predecessor(before: Motion, piece: Motion, gap: int) -> Motion:
    """Align a piece to the position and heading that the motion before it reaches after so many frames."""
    facing = heading(before.local_quat_xyzw[-1:, 0])
    turned = rotate_about_vertical(piece, facing - heading(piece.local_quat_xyzw[:1, 0]))
    velocity = _compute_mean_velocity(before.root_position[-_VELOCITY_FRAMES:])
    next_velocity = _compute_mean_velocity(turned.root_position[:_VELOCITY_FRAMES])
    target = before.root_position[-1] + (gap + 1) / 2 * (velocity + next_velocity)
    offset = target - turned.root_position[0]
    offset[1] = 0
    return replace(turned, root_position=turned.root_position + offset)


def _compute_mean_velocity(positions: Tensor) -> Tensor:
    """Compute the mean velocity, metres a frame."""
    return (positions[-1] - positions[0]) / max(1, len(positions) - 1)
