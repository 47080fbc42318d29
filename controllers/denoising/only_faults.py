"""Repair of a capture's faults alone: what is false comes from the denoised motion, feet are held by their legs and the
hips, and all other frames and joints stay to the bit.

Values of the denoised motion meet the capture without a jump in position or velocity at the edges of each fault. A toe
that slides is held where it stands before or after the slide, one that floats or penetrates at its support; hips take
what both feet share. What the legs change fades out within FADE_SECONDS.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.denoising.solution import DenoiseSolution
from mapctl.editing.rigged_motion import place_ankles
from mapctl.metrics.faults import Footing, list_faults
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import count_frames_to_observed, widen
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations, interpolate_offsets
from mapctl.problem.solution import Outcome, Status
from mapctl.recording.inspection import Artefact, travel
from mapctl.recording.masks import ROOT, Mask, MissingMask, expand_masks, restore_observed
from mapctl.retarget.rigs import Rig

FADE_SECONDS = 0.3
"""Seconds before and after a fault of a foot in which legs and hips may change."""
_STANDS_SECONDS = 0.1  # next to a slide in which its toe stands
_LEGS = [side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot")]
_WHOLE = ("noise", "stretch")  # kinds of faults that are in all frames
_MAX_NAMED = 6


def keep_all_but_faults(done: DenoiseSolution, exchanged: Motion) -> DenoiseSolution:
    """Return the capture with its faults repaired; `exchanged` is the capture with swapped limbs on their own sides.
    What could not be repaired is a note, and makes the outcome infeasible."""
    capture = done.capture
    false = expand_masks(capture, [_to_mask(fault) for fault in done.faults if fault.kind in _FALSE])
    false = replace(false, joints=false.joints | (exchanged.local_quat_xyzw != capture.local_quat_xyzw).any(dim=-1))
    motion = _plant_feet(_fill(capture, done.motion, false), done.rig)
    # What is filled in may be smooth: only what was smoothed before is named.
    left = [fault for fault in list_faults(motion, done.rig) if fault.kind not in (*_WHOLE, "smoothed")]
    left += [fault for fault in done.faults if fault.kind == "smoothed"]
    changed = (motion.local_quat_xyzw != capture.local_quat_xyzw).flatten(1).any(dim=1)
    changed |= (travel(motion) != travel(capture)).any(dim=1)
    notes = [f"only faults are repaired: {int(changed.sum())} of {len(changed)} frames are changed"]
    if any(fault.kind in _WHOLE for fault in done.faults):
        notes.append("noise and stretched bones are in all frames: they stay")
    if left:
        named = ", ".join(f"{each.kind} of {each.joint} in {each.start}:{each.stop}" for each in left[:_MAX_NAMED])
        more = f" and {len(left) - _MAX_NAMED} more" if len(left) > _MAX_NAMED else ""
        notes.append(f"not repaired: {named}{more}")
    outcome = Outcome.INFEASIBLE if left else Outcome.DONE
    return replace(done, motion=motion, status=Status(outcome, tuple(notes)))


_FALSE = ("spike", "dropout", "frozen")  # kinds of faults whose values are false


def _to_mask(fault: Artefact) -> Mask:
    return Mask(ROOT if fault.unit == "cm" else fault.joint, fault.start, fault.stop)


def _fill(capture: Motion, clean: Motion, false: MissingMask) -> Motion:
    """Fill false values from a clean motion, continuous in position and velocity."""
    fps, filled = float(capture.fps), restore_observed(clean, capture, false)

    def blend(track: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 3"]:
        return blend_seams_in_positions(track, false.root, fps=fps)

    blended = replace(
        filled,
        local_quat_xyzw=blend_seams_in_rotations(filled.local_quat_xyzw, false.joints, fps=fps),
        root_position=blend(filled.root_position),
        moving_offsets={joint: blend(track) for joint, track in filled.moving_offsets.items()},
    )
    return restore_observed(blended, capture, false)


def _plant_feet(motion: Motion, rig: Rig | None) -> Motion:
    """Hold the feet that slide, float or penetrate. Left as they are: slides of a toe that stands on both sides of it,
    at two positions, and faults that stay faults."""
    footing = Footing.of(motion, rig)
    faults = [fault for fault in footing.list_artefacts() if fault.kind != "slide" or not all(_stands(footing, fault))]
    fade = round(FADE_SECONDS * float(motion.fps))
    while faults:
        planted = _hold_toes(motion, footing, faults)
        still, kept = Footing.of(planted, rig).list_artefacts(), []
        for fault in faults:
            start, stop = max(0, fault.start - fade), fault.stop + fade
            again = any(one.joint == fault.joint and one.start < stop and start < one.stop for one in still)
            kept += [] if again else [fault]
        if len(kept) == len(faults):
            return planted
        faults = kept
    return motion


def _stands(footing: Footing, fault: Artefact) -> tuple[bool, bool]:
    """Return whether a toe that slides stands before and after it."""
    planted = footing.planted[:, footing.names.index(fault.joint)]
    beside = max(1, round(_STANDS_SECONDS * float(footing.rigged.motion.fps)))
    before, after = planted[max(0, fault.start - beside) : fault.start], planted[fault.stop : fault.stop + beside]
    return len(before) > 0 and bool(before.all()), len(after) > 0 and bool(after.all())


def _hold_toes(motion: Motion, footing: Footing, faults: Sequence[Artefact]) -> Motion:
    """Bring toes to where they stand, and in height to their supports, by hips and legs."""
    rigged, toes, fps = footing.rigged, footing.toes, float(motion.fps)
    offsets, slides = torch.zeros_like(toes), torch.zeros_like(footing.planted)
    near, off_floor = torch.zeros(2, motion.num_frames, dtype=torch.bool)
    for fault in faults:
        near[fault.start : fault.stop] = True
        if fault.kind != "slide":
            off_floor[fault.start : fault.stop] = True
            continue
        foot, span = footing.names.index(fault.joint), slice(fault.start, fault.stop)
        before, after = _stands(footing, fault)
        own = toes[span, foot]
        stand = own[0] if before else own[-1] if after else own.mean(dim=0)
        offsets[span, foot, ::2] = (stand - own)[:, ::2]
        slides[span, foot] = True
    held = footing.firm & widen(off_floor, round(FADE_SECONDS / 2 * fps))[:, None]
    offsets[..., 1] = torch.where(held, footing.supports - toes[..., 1], 0.0)
    away = count_frames_to_observed(near[None])[0].amin(dim=-1, keepdim=True).double()
    share = smootherstep(1 - away / (FADE_SECONDS * fps))

    def interpolate(values: Tensor, known: Tensor) -> Tensor:
        return share * interpolate_offsets(values, known, seconds=FADE_SECONDS, fps=fps)

    # Hips go up or down by the mean of what the feet ask for, and legs do the rest.
    shift = torch.zeros_like(toes[:, 0])
    mean = offsets[..., 1].sum(dim=1) / held.sum(dim=1).clamp_min(1)
    shift[:, 1:2] = interpolate(mean[:, None], held.any(dim=1))
    rigged = rigged.with_motion(rigged.shift_hips(shift))
    offsets[..., 1] -= torch.where(held, shift[:, 1:2], 0.0)
    ankles = rigged.positions("Foot")
    for foot in range(2):
        ankles[:, foot, ::2] += interpolate(offsets[:, foot, ::2], slides[:, foot])
        ankles[:, foot, 1:2] += interpolate(offsets[:, foot, 1:2], held[:, foot])
    planted = rigged.with_motion(place_ankles(rigged, ankles)).in_file_world(motion)
    changed = MissingMask(torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool), share[:, 0] > 0)
    changed.joints[:, [rigged.rigmap.joints[leg] for leg in _LEGS]] = share > 0
    return restore_observed(planted, motion, changed)
