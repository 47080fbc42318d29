"""Make whole what lacks frames or joints, on any rig: an infiller proposes joint positions (infilling paper), inverse
kinematics makes them rotations of rigid bones, and the MAP stage puts the feet down; what is known stays to the bit.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.canonical_gap import CanonicalGap
from controllers.standing import StandingSettings, stand
from mapctl import contacts, gaussian, inverse_kinematics, rotations
from mapctl.capture import Capture
from mapctl.capture.bands import upsampled
from mapctl.capture.faults import runs
from mapctl.curve import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.gaps import PositionImage
from mapctl.gaps.closing import closed_places, closed_rotations
from mapctl.gaps.course import along
from mapctl.gaps.lost import Lost, put_back, straight
from mapctl.gaps.targets import Targets, missed, reached
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import from_canonical, places_on_rig, to_canonical
from mapctl.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.result import Ledger
from mapctl.terms import Footing, Seam
from mapctl.terms.footing import TOES

Method = Literal["infiller", "map", "linear"]
_TOES = (CANONICAL.index(TOES[0]), CANONICAL.index(TOES[1]))
_TREMBLE, _MOMENT = 0.8, 10  # frames at the prior's rate
_FIDGET = 0.005  # metres
_SWAY, _PASSES = 10, 4  # frames at the prior's rate: slower than a step
_SURE = 4.0  # log odds of contacts that are known
_SWINGS = 0.5  # m/s from which a proposed toe swings, whatever the odds that it stands: held, it would jerk the leg
_MISSED = 0.001  # metres from a wanted place that are worth a word
_HAIR = 1e-4  # metres from it that are nothing
_AIMS = 6  # tries at most
_BESIDE = 16  # frames at the prior's rate, on either side of a gap, that the MAP stage sees


FINISHING = StandingSettings(
    ease=5.0, footing=Footing(sigma_speed=0.1, sigma_height=0.1, sigma_below=0.1), seam=Seam(sigma=50.0, frames=96),
    budget=Budget(evaluations=40), lbfgs=LbfgsSettings(max_iterations=40),
)  # fmt: skip
"""Of the MAP stage about an infiller's proposal, which is further off than a denoiser's: heights of toes are the
network's, since styles differ in them; jerk costs something; and it may take twice the evaluations."""


@dataclass(frozen=True)
class InfillSettings:
    """How gaps are filled."""

    method: Method = "map"
    """`infiller` leaves the proposal as it is, but for rigid bones; `map` finishes it; `linear` knows no network."""
    standing: StandingSettings = field(default_factory=lambda: FINISHING)
    """The MAP stage."""


@dataclass(frozen=True, eq=False)
class Infilled:
    """A whole motion, and how it became so."""

    motion: Motion
    """On the given rig, at its rate, with all of its frames."""
    lost: Lost
    """What was filled in."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted, at the prior's rate."""
    ledger: Ledger
    """Of the MAP stage, by term and frame at the prior's rate, of the frames that it saw."""
    seconds: float = 0.0
    """Compute, wall clock."""
    notes: tuple[str, ...] = ()
    """What the user should know."""

    def summary(self) -> dict[str, Any]:
        """For a report, in plain numbers."""
        filled = int(self.lost.frames.sum())
        gaps = [{"start": start, "stop": stop, "joints": int(self.lost.joints[start:stop].any(dim=0).sum()),
                 "root": bool(self.lost.root[start:stop].any())}
                for _, start, stop in runs(self.lost.frames[:, None])]  # fmt: skip
        return {
            "frames": self.motion.num_frames, "fps": float(self.motion.fps), "gaps": gaps,
            "ledger": self.ledger.summary(), "seconds": self.seconds,
            "frame_ms": 1000 * self.seconds / max(1, filled), "notes": list(self.notes),
        }  # fmt: skip


def fill(
    motion: Motion, lost: Lost, infiller: Inbetweener | None, *, settings: InfillSettings | None = None,
    densities: Sequence[Any] = (), rig: Rig | None = None, targets: Targets | None = None,
    course: Curve | None = None,
) -> Infilled:  # fmt: skip
    """What is lost of a motion, filled in; RequestError for a method without its network.

    `targets` are places that the rig's hands and feet are wanted at in frames in which they are lost; along `course`
    the hips go while they are.
    """
    settings, began = settings or InfillSettings(), time.perf_counter()
    if infiller is None and settings.method != "linear":
        raise RequestError(f"method {settings.method} needs an infiller")
    base = straight(motion, lost)
    if settings.method == "linear" or infiller is None:
        nothing = torch.zeros(0, 2, dtype=torch.bool)
        done, notes = _on_target(put_back(base, motion, lost), targets, lost, motion, rig)
        return Infilled(done, lost, nothing, Ledger(), time.perf_counter() - began, notes)
    canonical, rigmap = to_canonical(base, rig)
    if course is not None:
        canonical = along(canonical, lost.root, course)
    gap = CanonicalGap.of(canonical, lost, rigmap.joint_of)
    shown = None if targets is None else targets.shown(gap.seconds, fps=float(motion.fps))
    proposal, bits = _proposed(gap, infiller, shown, held=course is not None)
    stands, ledger = contacts.steadied(bits > 0), Ledger()
    if settings.method == "map":
        proposal, ledger = _stood(proposal, bits, gap, settings.standing, densities, shown)
    whole = _at_rate_of(canonical, proposal, gap.seconds)
    filled = from_canonical(whole, rigmap, base)
    done = _closed(put_back(filled, base, lost), lost, motion)
    done, notes = _on_target(done, targets, lost, motion, rig)
    return Infilled(done, lost, stands, ledger, time.perf_counter() - began, notes)


def _proposed(
    gap: CanonicalGap, infiller: Inbetweener, targets: Targets | None, *, held: bool
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """The infiller's motion on rigid bones, its seams closed, and the log odds of its contacts; `held` to its guess of
    where the hips go, but for their sway.
    """
    shown = gap.motion
    body = Motion(CANONICAL, shown.fps, shown.root_position / gap.scale, shown.local_quat_xyzw)
    places, known = body.joint_positions(), gap.places_known()
    if targets is not None:
        places = torch.where(targets.wanted[..., None], targets.places / gap.scale, places)
        known = known | targets.wanted
    stands = contacts.planted(places[:, list(_TOES)], PRIOR_FPS).float()
    image = PositionImage.of_world(
        places.float()[None], heading(shown.local_quat_xyzw[:, 0]).float()[None], stands[None],
        known=known[None], present=torch.ones(1, len(places), dtype=torch.bool), toes=_TOES,
    )  # fmt: skip
    proposed = infiller.propose(image)
    wanted = image.to_world(_without_tremble(proposed.places, image))[0].double()
    if held:
        wanted = wanted - _slow_way_off(wanted[:, 0] - body.root_position, gap.root)[:, None]
    root = torch.where(gap.root[:, None], wanted[:, 0], body.root_position)
    quats = inverse_kinematics.solve(wanted, shown.local_quat_xyzw, CANONICAL, free=gap.turns, root_position=root)
    quats = torch.where(gap.turns[..., None], quats, shown.local_quat_xyzw)
    quats = closed_rotations(quats, gap.turns, fps=PRIOR_FPS)
    root = closed_places(root * gap.scale, gap.root, fps=PRIOR_FPS)
    made = replace(shown, root_position=root, local_quat_xyzw=quats)
    bits = torch.where(_toe_speeds(made) < _SWINGS * gap.scale, proposed.contacts[0], -_SURE)
    return made, torch.where(image.known[0][:, list(_TOES)], _SURE * (2 * stands - 1), bits)


def _without_tremble(places: Float[Tensor, "1 frames joints 3"], image: PositionImage) -> Tensor:
    """A network's frames are each a little off on their own: what it changes is smoothed over about a frame. Where it
    changes next to nothing it only fidgets, and the guess is as good. What it leaves alone stays.
    """
    change = (places - image.places)[0]
    smooth = gaussian.convolved(change, gaussian.kernel(_TREMBLE, 3), "repeated")
    power = gaussian.convolved(smooth.square().sum(dim=-1), gaussian.kernel(_MOMENT, 3 * _MOMENT), "repeated")
    smooth = smooth * (power / (power + _FIDGET**2))[..., None]
    return torch.where(image.known[..., None], places, image.places + smooth)


def _slow_way_off(off: Float[Tensor, "frames 3"], lost: Bool[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
    """What hips stray by over the ground, without their sway; nothing where they are known."""
    off = torch.where(lost[:, None], off, 0.0) * torch.tensor([1.0, 0.0, 1.0], dtype=off.dtype)
    slow, taps = torch.zeros_like(off), gaussian.kernel(_SWAY, 4 * _SWAY)
    for _ in range(_PASSES):  # each takes the slow part of what the ones before it left
        slow = slow + torch.where(lost[:, None], gaussian.convolved(off - slow, taps, "repeated"), 0.0)
    return slow


def _toe_speeds(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Over the ground, m/s."""
    toes = motion.joint_positions()[:, list(_TOES)][..., ::2]
    return torch.diff(toes, dim=0, prepend=toes[:1]).norm(dim=-1) * float(motion.fps)


def _stood(
    proposal: Motion, bits: Tensor, gap: CanonicalGap, settings: StandingSettings, densities: Sequence[Any],
    targets: Targets | None,
) -> tuple[Motion, Ledger]:  # fmt: skip
    """The proposal with its feet put down, gap by gap; and the ledger of these."""
    quats, root, ledger = proposal.local_quat_xyzw.clone(), proposal.root_position.clone(), Ledger()
    for first, last in _surroundings(gap.turns.any(dim=1) | gap.root):
        if last - first < 2:
            continue
        part = slice(first, last)
        capture = Capture.of_motion(
            proposal.slice(first, last), seen=~gap.turns[part], seen_root=~gap.root[part],
            sigma=torch.zeros(CANONICAL.num_joints), sigma_root=0.0,
        )  # fmt: skip
        wanted = None if targets is None else Targets(targets.places[part], targets.wanted[part])
        stood = stand(proposal.slice(first, last), bits[part], capture, settings, densities=densities, targets=wanted)
        quats[part] = torch.where(gap.turns[part, :, None], stood.motion.local_quat_xyzw, quats[part])
        root[part] = torch.where(gap.root[part, None], stood.motion.root_position, root[part])
        ledger = ledger.join(stood.ledger)
    return replace(proposal, root_position=root, local_quat_xyzw=quats), ledger


def _surroundings(lost: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """First frame and one past the last of each gap with what is beside it; gaps that see each other are one."""
    near = lost.clone()
    for _, start, stop in runs(lost[:, None]):
        near[max(0, start - _BESIDE) : stop + _BESIDE] = True
    return [(start, stop) for _, start, stop in runs(near[:, None])]


def _at_rate_of(canonical: Motion, proposal: Motion, seconds: Float[Tensor, " shown"]) -> Motion:
    """The proposal at the given motion's rate, by splines through its frames."""
    if canonical.fps == PRIOR_FPS:
        return proposal
    frames, fps = canonical.num_frames, float(canonical.fps)
    quats = rotations.sign_continuous(proposal.local_quat_xyzw)
    quats = torch.nn.functional.normalize(upsampled(quats, seconds, fps=fps, frames=frames), dim=-1)
    return replace(canonical, root_position=upsampled(proposal.root_position, seconds, fps=fps, frames=frames),
                   local_quat_xyzw=quats)  # fmt: skip


def _closed(filled: Motion, lost: Lost, original: Motion) -> Motion:
    """On the rig, with seams that run on; what is known is the original's."""
    fps = float(original.fps)
    moving = {joint: closed_places(values, lost.root, fps=fps) for joint, values in filled.moving_offsets.items()}
    closed = replace(filled, moving_offsets=moving,
                     root_position=closed_places(filled.root_position, lost.root, fps=fps),
                     local_quat_xyzw=closed_rotations(filled.local_quat_xyzw, lost.joints, fps=fps))  # fmt: skip
    return put_back(closed, original, lost)


def _on_target(
    filled: Motion, targets: Targets | None, lost: Lost, original: Motion, rig: Rig | None
) -> tuple[Motion, tuple[str, ...]]:
    """With limbs that are at their places to the hair; and a word on those that do not reach."""
    if targets is None:
        return filled, ()
    canonical, rigmap = to_canonical(filled, rig)
    aim, done, away = targets, filled, torch.full((1,), torch.inf)
    for _ in range(_AIMS):
        there = reached(canonical, aim, lost.frames)
        done = put_back(from_canonical(there, rigmap, filled), original, lost)
        found = places_on_rig(done, rigmap)
        before, away = away, missed(found, targets)
        if float(away.max()) < _HAIR or float((away - before).abs().max()) < _HAIR:
            break
        # Joints that only the rig has carry a limb's end elsewhere than on canonical joints.
        aim = Targets(targets.places + there.joint_positions() - found, targets.wanted)
    notes = ()
    if float(away.max()) > _MISSED:
        worst = int(away.argmax())
        notes = (f"frame {worst}: a limb stays {100 * float(away.max()):.1f} cm from its place, out of reach",)
    return done, notes
