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
from mapctl.numerics.intervals import widen
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations, interpolate_offsets
from mapctl.problem.solution import Outcome, Status
from mapctl.recording.inspection import Artefact
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
    left = [fault for fault in list_faults(motion, done.rig) if fault.kind not in _WHOLE]
    changed = (motion.local_quat_xyzw != capture.local_quat_xyzw).any(dim=-1).any(dim=-1)
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
    """Hold the feet that slide, float or penetrate; faults that stay faults nevertheless are left as they are."""
    footing = Footing.of(motion, rig)
    faults = footing.list_artefacts()
    while faults:
        planted = _hold_toes(motion, footing, faults)
        still = Footing.of(planted, rig).list_artefacts()
        repaired = [fault for fault in faults if not any(_overlap(fault, other) for other in still)]
        if len(repaired) == len(faults):
            return planted
        faults = repaired
    return motion


def _overlap(one: Artefact, other: Artefact) -> bool:
    return one.joint == other.joint and one.start < other.stop and other.start < one.stop


def _hold_toes(motion: Motion, footing: Footing, faults: Sequence[Artefact]) -> Motion:
    rigged, toes, fps = footing.rigged, footing.toes, float(motion.fps)
    offsets, held = torch.zeros_like(toes), torch.zeros_like(footing.planted)
    for fault in faults:
        foot, span = footing.names.index(fault.joint), slice(fault.start, fault.stop)
        if fault.kind == "slide":
            offsets[span, foot, ::2] = (_find_stand(footing, fault, foot) - toes[span, foot])[:, ::2]
        else:
            offsets[span, foot, 1] = (footing.supports - toes[..., 1])[span, foot]
        held[span, foot] = True
    near = widen(held.any(dim=1), round(FADE_SECONDS * fps))

    def interpolate(values: Tensor, known: Tensor) -> Tensor:
        return interpolate_offsets(values, known | ~near, seconds=FADE_SECONDS, fps=fps)

    # Hips go up or down by as much as all feet that bear the body ask for.
    rise = torch.where(footing.bearing, offsets[..., 1], torch.inf).amin(dim=1).clamp_min(0)
    fall = torch.where(footing.bearing, offsets[..., 1], -torch.inf).amax(dim=1).clamp_max(0)
    firm = held.any(dim=1)
    shared = torch.where(firm, rise + fall, 0.0)
    shift = torch.zeros_like(toes[:, 0])
    shift[:, 1:2] = interpolate(shared[:, None], firm)
    rigged = rigged.with_motion(rigged.shift_hips(shift))
    offsets = torch.where(footing.bearing[..., None], offsets - shift[:, None], 0.0)
    ankles = [interpolate(offsets[:, foot], footing.bearing[:, foot]) for foot in range(2)]
    planted = place_ankles(rigged, rigged.positions("Foot") + torch.stack(ankles, dim=1))
    legs = torch.zeros(motion.num_joints, dtype=torch.bool)
    legs[[rigged.rigmap.joints[leg] for leg in _LEGS]] = True
    return restore_observed(
        rigged.with_motion(planted).in_file_world(motion), motion, MissingMask(near[:, None] & legs, near)
    )


def _find_stand(footing: Footing, fault: Artefact, foot: int) -> Float[Tensor, "3"]:
    """Find where a sliding toe is held: where it stands before the slide or after it, else at the middle of it."""
    toes, beside = footing.toes[:, foot], max(1, round(_STANDS_SECONDS * float(footing.rigged.motion.fps)))
    if footing.planted[max(0, fault.start - beside) : fault.start, foot].all():
        return toes[fault.start]
    if footing.planted[fault.stop : fault.stop + beside, foot].all():
        return toes[fault.stop - 1]
    return toes[fault.start : fault.stop].mean(dim=0)
