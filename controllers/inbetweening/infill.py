"""Fill the gaps of a motion: frames that are missing, or joints (Kaufmann et al. 2020, section 4.2); the hips'
trajectory alone, predicted from the body (Zhou et al. 2020, section 3.4); or what lies between pieces of clips."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import torch

from controllers.inbetweening.pipeline import FillOptions, InbetweenSolution, fill
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.inbetweening.root_trajectory import TREMBLE_HZ, LocalMotion, close_path
from mapctl.kinematics import heading
from mapctl.kinematics.moving import rotate_about_vertical
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import smooth_between
from mapctl.protocols import Inbetweener, PathPredictor
from mapctl.recording.masks import ALL, Mask, MissingMask, expand_masks, resolve_joint_names
from mapctl.retarget import identify_rig
from mapctl.retarget.carry import RiggedCharacter, retarget_motion


@dataclass(frozen=True, eq=False)
class RetracedInbetweener(Inbetweener):
    """In-betweener that lets another propose the poses that are missing, and predicts the hips' trajectory wherever it
    is lost while the body is known: calmed, since hips that follow from how toes move tremble with these."""

    path: PathPredictor
    """Predictor of the trajectory."""
    poses: Inbetweener | None = None
    """In-betweener for missing poses; none where none are missing."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the poses' motion along the predicted trajectory, which leads from the last known position of the
        hips to the next. Gaps in which nothing at all is known keep the trajectory that was proposed with them."""
        if self.poses is None:
            posed = Proposal(query.motion, estimate_contact_logits(query.motion), "path")
        else:
            posed = self.poses.propose(query, generator=generator)
        lost = torch.zeros_like(query.missing.root)
        for _, start, stop in true_intervals(query.missing.root[:, None]):
            lost[start:stop] = not bool(query.nothing_known[start:stop].all())
        body = query.to_unit_size(posed.motion)
        facing = heading(body.local_quat_xyzw[:, 0])
        # Wherever the hips were said to be, even the last bit of the answer must not depend on it.
        seen = replace(body, root_position=torch.zeros_like(body.root_position)).joint_positions()
        predicted = self.path.predict(LocalMotion.of_world(seen.float()[None], facing.float()[None]))
        root = close_path(predicted.integrate(facing[None].float())[0].double(), body.root_position, lost)
        root = smooth_between(root, ~lost, hertz=TREMBLE_HZ, fps=PRIOR_FPS)
        motion = query.to_character(replace(body, root_position=root))
        logits = torch.where(lost[:, None], predicted.contacts[0], posed.contact_logits)
        return replace(posed, motion=motion, contact_logits=logits)


def infill(
    motion: Motion,
    inbetweener: Inbetweener,
    masks: Sequence[Mask],
    *,
    curve: Curve | None = None,
    **options: Unpack[FillOptions],
) -> InbetweenSolution:
    """Fill the masked joints and frames. RequestError for masks that do not fit.

    Values within a gap are ignored. A gap at the motion's beginning or end is extrapolated. Along a `curve` the hips go
    while they are missing; the in-betweener's rough one then proposes, since others leave it.
    """
    rig = options.get("rig")
    masks = resolve_joint_names(motion, masks, rig)
    # The rig must not be identified from values within a gap.
    shown = interpolate_missing(motion, expand_masks(motion, masks))
    missing = MissingMask.of_masks(motion, masks, identify_rig(shown.skeleton, rig, motion=shown))
    if curve is not None and not missing.root.any():
        raise RequestError("the hips follow a curve where they are missing, and they never are; leave it out")
    return fill(motion, missing, inbetweener if curve is None else inbetweener.rough, curve=curve, **options)


def retraced(
    motion: Motion,
    path: PathPredictor,
    masks: Sequence[Mask],
    *,
    inbetweener: Inbetweener | None = None,
    **options: Unpack[FillOptions],
) -> InbetweenSolution:
    """Predict the hips' trajectory where masks mark it as lost (`ROOT`); known frames stay to the bit.

    Masks of joints and of everything are gaps, which the `inbetweener` fills first; where both meet, the trajectory
    goes by the filled poses. Where no position is known at all the trajectory begins over the origin. RequestError for
    masks that do not fit, for gaps without an in-betweener, and for gaps in a motion without any position.
    """
    rig = options.get("rig")
    masks = resolve_joint_names(motion, masks, rig)
    lost = expand_masks(motion, masks)
    if bool(lost.joints.any()) and inbetweener is None:
        raise RequestError("joints are missing as well as the trajectory; an in-betweener must propose them")
    if bool(lost.root.all()) and bool(lost.joints.any()):
        raise RequestError("the trajectory is lost over all frames of a motion whose joints are lost as well")
    if not bool(lost.root.any()):
        raise RequestError("no frame's trajectory is lost; there is nothing to predict")
    shown = interpolate_missing(motion, lost)
    rigmap = identify_rig(shown.skeleton, rig, motion=shown)
    missing = MissingMask.of_masks(motion, masks, rigmap, keep_position=False)
    return fill(motion, missing, RetracedInbetweener(path, inbetweener), **options)


_VELOCITY_FRAMES = 5  # frames over which the velocity at a piece's end is estimated


def chain(
    clips: Sequence[Motion],
    inbetweener: Inbetweener,
    *,
    piece: int = 40,
    gap: tuple[int, int] = (50, 100),
    **options: Unpack[FillOptions],
) -> InbetweenSolution:
    """Chain pieces of clips to a motion on the first clip's rig at PRIOR_FPS. RequestError for fewer than two clips.

    Of every clip `piece` frames are taken, from its middle, or all of a shorter one. Each piece is aligned to the one
    before: the trajectory goes on at its velocity for half of the gap, then at the next one's. The generator samples
    each gap's frames, from the fewest to the most of `gap`, then is the in-betweener's. `rig` is that of all clips.
    """
    if piece < 2 or not 1 <= gap[0] <= gap[1] <= 900:
        raise RequestError(f"pieces need 2 frames or more and gaps 1 to 900, got {piece} and {gap}")
    rig = options.get("rig")
    options["generator"] = generator = options.get("generator") or torch.Generator().manual_seed(0)
    if len(clips) < 2:
        raise RequestError(f"a chain needs at least two clips, got {len(clips)}")
    body, notes = RiggedCharacter.of(clips[0], rig)[1], []
    whole: Motion | None = None
    masks: list[Mask] = []
    for clip in clips:
        retargeted = retarget_motion(clip, body, rig)
        notes += retargeted.changes.notes
        motion = retargeted.motion.resample(PRIOR_FPS)
        count = min(piece, motion.num_frames)
        start = (motion.num_frames - count) // 2
        excerpt = replace(motion.slice(start, start + count), source=None)
        if whole is None:
            whole = excerpt
            continue
        frames = int(torch.randint(gap[0], gap[1] + 1, (), generator=generator))
        masks.append(Mask(ALL, whole.num_frames, whole.num_frames + frames))
        held = whole.pick(torch.full((frames,), whole.num_frames - 1))
        whole = whole.join(held).join(_align_to_predecessor(whole, excerpt, frames))
    assert whole is not None, "there are clips"
    done = infill(body.on_rig(whole), inbetweener, masks, **options)
    return replace(done, status=done.status.with_notes(notes))


def _align_to_predecessor(before: Motion, piece: Motion, gap: int) -> Motion:
    """Align a piece to the position and heading that the motion before it reaches after so many frames."""
    facing = heading(before.local_quat_xyzw[-1:, 0])
    turned = rotate_about_vertical(piece, facing - heading(piece.local_quat_xyzw[:1, 0]))
    ends = before.root_position[-_VELOCITY_FRAMES:], turned.root_position[:_VELOCITY_FRAMES]
    velocity, next_velocity = ((end[-1] - end[0]) / max(1, len(end) - 1) for end in ends)  # metres a frame
    offset = before.root_position[-1] + (gap + 1) / 2 * (velocity + next_velocity) - turned.root_position[0]
    offset[1] = 0
    return replace(turned, root_position=turned.root_position + offset)
