"""Denoise a capture on any rig (rnn paper, section 5.4): what is to be believed, a proposal, and the MAP about it.

A network that has seen all kinds of motion proposes; what it leaves out and noise does not explain goes back in, so
that out of its depth it is no worse than a low-pass filter; the MAP stage puts the feet down. The result is on the
capture's own rig, at its own rate, with all of its frames.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.standing import StandingSettings, stand
from mapctl import retarget, rotations
from mapctl.capture import Capture
from mapctl.capture.bands import split
from mapctl.capture.examine import Examined, examine
from mapctl.capture.masks import Mask
from mapctl.capture.noise import angle_noise, place_noise
from mapctl.capture.residuals import returned
from mapctl.capture.smoothing import smoothed_angles
from mapctl.capture.spikes import leaps
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.retarget import RigMap, to_canonical
from mapctl.skeleton import CANONICAL
from mapctl.solver.result import Ledger

_SHORTEST = 8  # frames of a capture that noise can be told in


@dataclass(frozen=True)
class DenoiseSettings:
    """What is known of the capture, and how the search is done."""

    sigma_deg: float | None = None
    """Noise of each of a joint's angles; told from the capture, joint by joint, if None."""
    sigma_cm: float | None = None
    """Noise of each coordinate of the hips; told from the capture if None."""
    standing: StandingSettings = field(default_factory=StandingSettings)
    """The MAP stage."""

    def __post_init__(self):
        for name in ("sigma_deg", "sigma_cm"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 100:
                raise RequestError(f"{name} must lie between 0 and 100, got {value:g}")


@dataclass(frozen=True, eq=False)
class Denoised:
    """A clean motion, and what was found and changed."""

    motion: Motion
    """On the capture's rig, at its rate."""
    examined: Examined
    """What of the capture was not believed, and how noisy it is, on its own rig."""
    proposal: Motion
    """Canonical, at the prior's rate: before the MAP stage."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted, at the prior's rate."""
    believed: Float[Tensor, "frames joints"]
    """By frame at the prior's rate and canonical joint: 1 where the proposal was followed, 0 where the capture itself,
    smoothed, took its place."""
    ledger: Ledger
    """Of the MAP stage, by term and frame at the prior's rate."""
    seconds: float
    """Compute, wall clock."""
    notes: tuple[str, ...] = ()
    """What the user should know."""


def denoise(
    motion: Motion, denoiser: Any, *, masks: Sequence[Mask] = (), settings: DenoiseSettings | None = None,
    density: Any = None,
) -> Denoised:  # fmt: skip
    """Denoise a motion on any rig that `mapctl.rigs` can tell; RequestError for others and for masks that do not fit.

    `denoiser` proposes (see priors.load_denoiser); a `density` adds its likelihood to the MAP stage. A T-pose in frame
    0, as many captures begin with, stays as it is.
    """
    began, settings = time.perf_counter(), settings or DenoiseSettings()
    examined = examine(motion, masks)
    lead = 1 if begins_with_tpose(motion) else 0
    if motion.num_frames - lead < _SHORTEST:
        return _untouched(motion, examined, began)
    notes = ("frame 0 is a T-pose and stays as it is",) if lead else ()
    part = examined.slice(lead, motion.num_frames)
    done = _Pass(part, denoiser, settings).run(density)
    result = motion.slice(0, lead).join(done.motion) if lead else done.motion
    return replace(done, motion=result, examined=examined, seconds=time.perf_counter() - began, notes=notes)


def begins_with_tpose(motion: Motion) -> bool:
    """Whether frame 0 is a T-pose and the motion is not: arms out, everything straight, and then not."""
    canonical, _ = to_canonical(motion)
    turned = torch.rad2deg(rotations.to_rotation_vector(canonical.local_quat_xyzw[:, 1:]).norm(dim=-1))
    arms = turned[:, [CANONICAL.index(name) - 1 for name in ("leftUpperArm", "rightUpperArm")]].amin(dim=-1)
    straight = bool(arms[0] < 25) and bool(turned[0].mean() < 15)
    return straight and motion.num_frames > 1 and bool(arms[1:].median() > 40)


class _Pass:
    """From an examined capture to a clean motion."""

    def __init__(self, examined: Examined, denoiser: Any, settings: DenoiseSettings):
        self.examined, self.denoiser, self.settings = examined, denoiser, settings
        self.repaired = _others_smoothed(examined)
        canonical, self.rigmap = to_canonical(self.repaired)
        seen = _on_canonical(examined.seen, self.rigmap)
        self.sigma, self.sigma_root = self._noise(canonical, seen)
        self.bands = split(canonical)
        if self.bands.whole:
            # Nothing is filtered: the network is shown the frames as they came, and told which not to look at.
            self.bands = split(to_canonical(examined.motion)[0])
        self.shown = self.bands.at_prior_rate()
        self.capture = self._capture(seen)

    def run(self, density: Any) -> Denoised:
        """Propose, give back, put the feet down, return to the rig."""
        proposal, contacts = self._propose()
        if self.bands.whole:
            self.capture = self._look_again(proposal)
            proposal, contacts = self._propose()
        proposal, share = self._given_back(proposal)
        stood = stand(proposal, contacts, self.capture, self.settings.standing, density=density)
        joined = self.bands.joined(self.shown, stood.motion, self.sigma, self.sigma_root)
        motion = retarget.from_canonical(joined, self.rigmap, self.repaired)
        return Denoised(motion, self.examined, proposal, stood.contacts, 1 - share, stood.ledger, 0.0)

    def _noise(self, canonical: Motion, seen: Tensor) -> tuple[Float[Tensor, " joints"], float]:
        """Of the canonical joints' angles (radians) and of the hips' place (metres), at the capture's rate."""
        wanted = self.settings
        sigma = angle_noise(canonical.local_quat_xyzw, seen)
        if wanted.sigma_deg is not None:
            # Joints that never move have no noise either: they are locked, or the rig has none there.
            sigma = torch.where(sigma > 0, math.radians(wanted.sigma_deg), 0.0).to(sigma)
        root = place_noise(canonical.root_position, self.examined.seen_root)
        return sigma, root if wanted.sigma_cm is None else wanted.sigma_cm / 100

    def _capture(self, seen: Tensor) -> Capture:
        """What the network is shown, at its own rate."""
        root = self.examined.seen_root[:, None]
        sigma = self.bands.noise_at_prior_rate(self.sigma)
        sigma_root = self.bands.noise_at_prior_rate(torch.tensor(self.sigma_root))
        return Capture.of_motion(self.shown, seen=self._resampled(seen), seen_root=self._resampled(root)[:, 0],
                                 sigma=sigma, sigma_root=float(sigma_root))  # fmt: skip

    def _resampled(self, seen: Bool[Tensor, "frames columns"]) -> Bool[Tensor, "shown columns"]:
        """Seen at the prior's rate is what was seen in half of the frames about there."""
        ratio = float(self.examined.motion.fps) / float(self.shown.fps)
        side = max(0, round((ratio - 1) / 2))
        padded = torch.nn.functional.pad(seen.double().T[:, None], (side, side), mode="replicate")
        share = torch.nn.functional.avg_pool1d(padded, 2 * side + 1, stride=1)[:, 0].T
        at = (torch.arange(self.shown.num_frames) * ratio).round().long().clamp(max=len(seen) - 1)
        return share[at] >= 0.5

    def _propose(self) -> tuple[Motion, Float[Tensor, "frames 2"]]:
        """The network's motion on the performer's bones, and the log odds of contacts."""
        scale = _leg(CANONICAL.offsets) / _leg(self.rigmap.skeleton.offsets)
        asked = replace(self.capture, root=self.capture.root * scale, sigma_root=self.capture.sigma_root * scale)
        cleaned = self.denoiser.clean(asked)
        quats = rotations.sign_continuous(cleaned.local_quat_xyzw[0].double())
        motion = Motion(self.rigmap.skeleton, self.shown.fps, cleaned.root[0].double() / scale, quats)
        return motion, cleaned.contacts[0]

    def _look_again(self, proposal: Motion) -> Capture:
        """Spikes told anew by what is left beside the proposal: fast motion that passed for one is seen again."""
        dropouts = ~_on_canonical(~self.examined.dropouts, self.rigmap)
        spikes = leaps(self._rest(proposal), self.capture.sigma[0].double())
        hidden = self.examined.dropouts_root
        root = (self.shown.root_position - proposal.root_position)[:, None]
        leap = leaps(root, self.capture.sigma_root.double())[:, 0]
        return replace(self.capture, seen=~(dropouts | spikes)[None], seen_root=~(hidden | leap)[None])

    def _given_back(self, proposal: Motion) -> tuple[Motion, Float[Tensor, "frames joints"]]:
        """The proposal with the motion that it left out, and the share of that by frame and joint."""
        capture = self.capture
        angles, share = returned(self._rest(proposal), capture.seen[0], capture.sigma[0].double())
        place = (self.shown.root_position - proposal.root_position)[:, None]
        root, _ = returned(place, capture.seen_root[0][:, None], capture.sigma_root.double())
        quats = rotations.multiply(proposal.local_quat_xyzw, rotations.from_rotation_vector(angles))
        changed = replace(proposal, root_position=proposal.root_position + root[:, 0], local_quat_xyzw=quats)
        return changed, share

    def _rest(self, proposal: Motion) -> Float[Tensor, "frames joints 3"]:
        """By which turns the capture differs from the proposal."""
        turned = rotations.multiply(rotations.inverse(proposal.local_quat_xyzw), self.shown.local_quat_xyzw)
        return rotations.to_rotation_vector(turned)


def _others_smoothed(examined: Examined) -> Motion:
    """The repaired capture; joints that the canonical skeleton lacks, as fingers, are smoothed as their noise asks."""
    motion = examined.repaired()
    used = set(retarget.map_rig(motion.skeleton).joint_of)
    others = [j for j in range(motion.num_joints) if j not in used and examined.noise[j] > 0]
    if not others:
        return motion
    quats = motion.local_quat_xyzw.clone()
    quats[:, others] = smoothed_angles(quats[:, others], examined.noise[others])
    return replace(motion, local_quat_xyzw=quats)


def _on_canonical(seen: Bool[Tensor, "frames rigged"], rigmap: RigMap) -> Bool[Tensor, "frames joints"]:
    """A canonical joint is seen if its own joint of the rig is, and all that lie between it and the one above."""
    parents = rigmap.rig_skeleton.parents
    columns = []
    for canonical, joint in enumerate(rigmap.joint_of):
        above = rigmap.joint_of[CANONICAL.parents[canonical]] if canonical else None
        column = torch.ones(len(seen), dtype=torch.bool)
        while joint is not None and joint >= 0 and joint != above:
            column = column & seen[:, joint]
            joint = parents[joint]
        columns.append(column)
    return torch.stack(columns, dim=1)


def _leg(offsets: Float[Tensor, "joints 3"]) -> float:
    """From hip to ankle along the bones, metres."""
    bones = [CANONICAL.index(name) for name in ("leftLowerLeg", "leftFoot")]
    return float(offsets[bones].norm(dim=-1).sum())


def _untouched(motion: Motion, examined: Examined, began: float) -> Denoised:
    """Too short to tell noise from motion."""
    proposal = to_canonical(motion)[0]
    nothing = torch.zeros(motion.num_frames, 2, dtype=torch.bool)
    believed = torch.zeros(motion.num_frames, CANONICAL.num_joints)
    note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
    return Denoised(motion, examined, proposal, nothing, believed, Ledger(), time.perf_counter() - began, (note,))
