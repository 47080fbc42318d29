"""Denoise a capture on any rig (rnn paper, section 5.4): what is to be believed, a proposal, and the MAP about it.

A network that has seen all kinds of motion proposes; what it leaves out and noise does not explain goes back in, so
that out of its depth it is no worse than a low-pass filter; the MAP stage puts the feet down. The result is on the
capture's own rig, at its own rate, with all of its frames.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.denoise_piece import DenoiseSettings, Piece
from controllers.denoised import Denoised, joined
from mapctl import rotations
from mapctl.capture.examine import examine
from mapctl.capture.masks import Mask, after, by_own_names, masked, part_of, written_back
from mapctl.motion import Motion
from mapctl.protocols import Denoiser
from mapctl.retarget import RigMap, from_canonical, settled, to_canonical
from mapctl.rigs import Rig
from mapctl.skeleton import CANONICAL
from mapctl.solver.result import Ledger

__all__ = ["DenoiseSettings", "Denoised", "begins_with_tpose", "denoise"]

_SHORTEST = 8  # frames of a capture that noise can be told in
_TELLING = 3000  # frames that show what rig a capture is on
_NEAR_REST = 5.0  # times the noise of one angle, that a resting joint is turned by at most
_NOISY_DEG, _SPIKE_DEG = 1.0, 60.0
_PIECE, _SHARED = 60.0, 2.0  # seconds of a long capture that are cleaned at once, and that two pieces share


def denoise(
    motion: Motion, denoiser: Denoiser, *, masks: Sequence[Mask] = (), settings: DenoiseSettings | None = None,
    densities: Sequence[Any] = (), rig: Rig | None = None, progress: Callable[[int, int], None] | None = None,
) -> Denoised:  # fmt: skip
    """Denoise a motion on any rig that `mapctl.rigs` can tell, or on a given one; RequestError for others and for masks
    that do not fit.

    `denoiser` proposes (see priors.load_denoiser). Of `densities` the likeliest adds its likelihood to each window of
    the MAP stage. A T-pose in frame 0, as many captures begin with, stays. A long capture is cleaned in pieces that
    fade into each other, so memory beyond the capture's own does not grow with it. `progress` is called with frames
    done and all frames.
    """
    settings = settings or DenoiseSettings()
    masks = by_own_names(motion, masks, rig)
    masked(motion, masks)  # whole: of a piece they are cut to its frames
    # Told once: a piece may lack what shows the rig's T-pose.
    beginning, rigmap = to_canonical(_beginning(motion), rig)
    rig = settled(rigmap)
    lead = 1 if _shows_tpose(beginning) else 0
    frames = motion.num_frames - lead
    long, shared = (max(_SHORTEST, round(seconds * float(motion.fps))) for seconds in (_PIECE, _SHARED))
    pieces: list[tuple[Denoised, int]] = []
    start = stop = 0
    while stop < frames:
        before, stop = stop, frames if frames - start <= long + shared else start + long
        part, hidden = motion.slice(lead + start, lead + stop), part_of(masks, lead + start, lead + stop)
        if pieces:  # what the piece before made of lost joints is all that is known of them
            last, first = pieces[-1]
            part = written_back(part, last.motion.slice(start - first, before - first), hidden)
            hidden = after(hidden, before - start)
        pieces.append((_cleaned(part, denoiser, hidden, settings, densities, rig), start))
        start = stop - shared
        if progress is not None:
            progress(lead + stop, motion.num_frames)
    done = replace(joined(pieces), capture=motion.slice(lead, motion.num_frames), rig=rig)
    return _led_by(motion, done, rigmap) if lead else done


def begins_with_tpose(motion: Motion, rig: Rig | None = None) -> bool:
    """Whether frame 0 is a T-pose and the motion is not: arms out, everything straight, and then not."""
    return _shows_tpose(to_canonical(_beginning(motion), rig)[0])


def _shows_tpose(canonical: Motion) -> bool:
    turned = torch.rad2deg(rotations.to_rotation_vector(canonical.local_quat_xyzw[:, 1:]).norm(dim=-1))
    arms = turned[:, [CANONICAL.index(name) - 1 for name in ("leftUpperArm", "rightUpperArm")]].amin(dim=-1)
    straight = bool(arms[0] < 25) and bool(turned[0].mean() < 15)
    return straight and canonical.num_frames > 1 and bool(arms[1:].median() > 40)


def _beginning(motion: Motion) -> Motion:
    """As much as is looked at to tell a rig."""
    return motion.slice(0, min(motion.num_frames, _TELLING))


def _cleaned(
    motion: Motion, denoiser: Denoiser, masks: Sequence[Mask], settings: DenoiseSettings, densities: Sequence[Any],
    rig: Rig,
) -> Denoised:  # fmt: skip
    began = time.perf_counter()
    examined = examine(motion, masks)
    if motion.num_frames < _SHORTEST:
        nothing = torch.zeros(motion.num_frames, 2, dtype=torch.bool)
        believed = torch.zeros(motion.num_frames, CANONICAL.num_joints)
        note = f"{motion.num_frames} frames are too few to tell noise from motion: nothing was changed"
        return Denoised(motion, motion, examined.noise, examined.noise_root, (), nothing, believed, Ledger(),
                        notes=(note,))  # fmt: skip
    done = Piece(examined, denoiser, settings, rig).run(densities)
    return replace(done, seconds=time.perf_counter() - began)


def _led_by(motion: Motion, done: Denoised, rigmap: RigMap) -> Denoised:
    """With frame 0 before it: a T-pose, from which joints go back to rest that are there but for the noise."""
    first = motion.slice(0, 1)
    rest = min(_rests(motion, rigmap), key=lambda quats: float(_apart(quats, first.local_quat_xyzw).mean()))
    # In a noisy capture a joint that is further off has been hit by a spike.
    reach = torch.where(done.noise > math.radians(_NOISY_DEG), math.radians(_SPIKE_DEG), _NEAR_REST * done.noise)
    # But for the hips and what carries them: a T-pose may face another way than the rig's.
    carriers = [joint := rigmap.joint_of[0] or 0]
    while (joint := motion.skeleton.parents[joint]) >= 0:
        carriers.append(joint)
    reach[carriers] = _NEAR_REST * done.noise[carriers]
    at_rest = _apart(rest, first.local_quat_xyzw) < reach
    first = replace(first, local_quat_xyzw=torch.where(at_rest[..., None], rest, first.local_quat_xyzw))
    faults = tuple(replace(fault, start=fault.start + 1, stop=fault.stop + 1) for fault in done.faults)
    stretches = tuple(replace(part, start=part.start + 1, stop=part.stop + 1) for part in done.stretches)
    note = "frame 0 is a T-pose: it stays, but for noise of joints at rest"
    return replace(done, motion=first.join(done.motion), capture=motion, faults=faults, stretches=stretches,
                   notes=(note, *done.notes))  # fmt: skip


def _rests(motion: Motion, rigmap: RigMap) -> list[Float[Tensor, "1 joints 4"]]:
    """Local rotations that a T-pose may be meant to have: none, as in CMU's takes, and those of the rig's T-pose."""
    none = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    tpose = Motion(rigmap.skeleton, motion.fps, torch.zeros(1, 3, dtype=torch.float64),
                   none.expand(1, CANONICAL.num_joints, 4))  # fmt: skip
    return [none.expand(1, motion.num_joints, 4), from_canonical(tpose, rigmap).local_quat_xyzw]


def _apart(first: Float[Tensor, "1 joints 4"], second: Float[Tensor, "1 joints 4"]) -> Float[Tensor, "1 joints"]:
    """Angles between rotations, radians."""
    return rotations.to_rotation_vector(rotations.multiply(rotations.inverse(first), second)).norm(dim=-1)
