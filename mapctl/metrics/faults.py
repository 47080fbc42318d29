"""Faults of a recording on its own rig, as a list: what is wrong with its values, and where its feet leave their floor.

A toe bears the body where it is planted, and also where neither is, near its support and below the hips: there a body
slides as a whole. Steps of planted toes in captures are short or slow; what lasts and is fast is a slide.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.contacts import fit_supports
from mapctl.editing.looping import choose_smoothing, find_contacts
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import widen
from mapctl.recording.inspection import (
    MIN_FRAMES,
    Artefact,
    Inspection,
    correct_structure,
    inspect_recording,
    list_artefacts,
    list_value_artefacts,
)
from mapctl.retarget import as_rig
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import TOES

_SLIDE_SPEED, _SLIDE_SECONDS = 0.2, 0.3  # m/s of a toe that bears the body, and how long it lasts
_OFF_FLOOR, _OFF_SECONDS = 0.03, 0.1  # metres of a planted toe over or under its support, and how long
_EDGE_SECONDS = 0.1  # at the ends of a contact, in which a toe is on its way down or up
_NEAR, _BELOW = 0.02, 0.5  # metres from its support, and radians from the vertical to the hips, of a toe that bears


def list_faults(motion: Motion, rig: Rig | None = None) -> list[Artefact]:
    """List the faults of a motion, the worst first: a degree counts as a centimetre, which it is 57 cm from the joint.
    `rig` wins over what would be recognised; RequestError where the rig's joints cannot be identified."""
    hidden = torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    whole, rigmap, shares, faults = correct_structure(motion, rig, hidden)
    lead = len(shares)
    for fault in list_inspected_faults(inspect_recording(whole.slice(lead, whole.num_frames)), as_rig(rigmap)):
        faults.append(replace(fault, start=fault.start + lead, stop=fault.stop + lead))
    return sorted(faults, key=lambda fault: -fault.amount)


def list_inspected_faults(inspection: Inspection, rig: Rig | None) -> list[Artefact]:
    """List the faults of an inspected recording; feet are judged with its false values filled in, but not where the
    body's position is false."""
    feet = Footing.of(inspection.repaired(), rig).list_artefacts()
    known = [fault for fault in feet if not inspection.dropouts_root[fault.start : fault.stop].any()]
    return [*list_value_artefacts(inspection), *known]


@dataclass(frozen=True, eq=False)
class Footing:
    """Toes of a motion, noise smoothed away, with what they stand on; left and right."""

    rigged: RiggedMotion
    toes: Float[Tensor, "frames 2 3"]
    """World positions, metres, Y up."""
    planted: Bool[Tensor, "frames 2"]
    bearing: Bool[Tensor, "frames 2"]
    """Whether a toe is planted, or would have to be."""
    firm: Bool[Tensor, "frames 2"]
    """Whether a toe is planted, but for the ends of contacts, in which it is on its way down or up."""
    supports: Float[Tensor, "frames 2"]
    """Height at which each toe rests, metres."""

    @staticmethod
    def of(motion: Motion, rig: Rig | None) -> "Footing":
        """Find the contacts; RequestError where the rig's joints cannot be identified."""
        rigged, fps = RiggedMotion.of(motion, rig), float(motion.fps)
        toes, hips = rigged.positions("Toes"), rigged.position("hips")
        planted = find_contacts(toes, hips, fps) & (motion.num_frames >= MIN_FRAMES)
        toes = gaussian.smooth(toes, choose_smoothing(toes, fps))
        supports, up = fit_supports(toes, planted), hips[:, None] - toes
        near = (toes[..., 1] - supports).abs() < _NEAR
        below = torch.atan2(up[..., ::2].norm(dim=-1), up[..., 1]) < _BELOW
        edge = max(1, round(_EDGE_SECONDS * fps))
        firm = torch.stack([~widen(~foot, edge) for foot in planted.unbind(dim=1)], dim=1)
        bearing = planted | (~planted.any(dim=1, keepdim=True) & near & below)
        return Footing(rigged, toes, planted, bearing, firm, supports)

    @property
    def names(self) -> list[str]:
        """Names of the toes on the rig, or canonical ones where it has none."""
        return [self.rigged.rigmap.joint_names.get(toe, toe) for toe in TOES]

    def list_artefacts(self) -> list[Artefact]:
        """List slides of toes that bear the body, by their length, and firmly planted toes that float over or penetrate
        their support, by the largest height or depth."""
        names, fps, toes = self.names, float(self.rigged.motion.fps), self.toes
        ahead, behind = (torch.cat(each) for each in ((toes[1:], toes[-1:]), (toes[:1], toes[:-1])))
        steps, height = (ahead - behind)[..., ::2].norm(dim=-1) / 2, toes[..., 1] - self.supports
        slides = self.bearing & (steps * fps > _SLIDE_SPEED)
        found = list_artefacts(names, slides, "slide", "cm", steps, total=lambda part: 100 * part.sum())
        found = [fault for fault in found if fault.stop - fault.start >= _SLIDE_SECONDS * fps]
        # Beside a foot that stands the other may be put on anything.
        stands = (self.planted & (height <= _OFF_FLOOR)).any(dim=1, keepdim=True)
        off = list_artefacts(names, self.firm & (height > _OFF_FLOOR) & ~stands, "float", "cm", 100 * height)
        off += list_artefacts(names, self.firm & (height < -_OFF_FLOOR), "penetration", "cm", -100 * height)
        return found + [fault for fault in off if fault.stop - fault.start >= _OFF_SECONDS * fps]
