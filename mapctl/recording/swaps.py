"""Limbs whose left and right are exchanged for a few frames, as by a tracker that mistakes its labels.

A run of frames is exchanged back where the frames beside it predict the exchanged rotations better than those captured,
by the Bayes factor of all joints of both limbs together; a rotation that neither explains may be an outlier, so that no
single joint decides (Kass and Raftery 1995).
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.inspection import ROTATIONS, SHARE, Artefact, predict_frames
from mapctl.recording.noise_estimation import RESOLUTION, choose_continuous_signs
from mapctl.retarget import RigMap

_MOST_FRAMES = 4  # of a run: what differs for longer may be a turn of the body
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
_LIMBS = ((("UpperLeg", "LowerLeg", "Foot", "Toes"),), (_ARM, _ARM[1:]))  # a tracker may know no shoulders
_OUTLIER = math.log(SHARE / ROTATIONS)
_ROUNDS = 2


def exchange_swapped_limbs(
    motion: Motion, rigmap: RigMap, hidden: Bool[Tensor, "frames joints"]
) -> tuple[Motion, list[Artefact]]:
    """Return the motion with limbs exchanged back where left and right were swapped, and these frames as faults.

    Rotations are exchanged as those from the T-pose, or as they are in the file, whichever is likelier.
    """
    quats, faults = motion.local_quat_xyzw.clone(), []
    own, rigged, parents = motion.local_quat_xyzw, rigmap.joints, torch.tensor(motion.skeleton.parents)
    rests = (rigmap.rest_quat_xyzw.to(quats), quats.new_tensor([0, 0, 0, 1]).expand(quats.shape[1], 4))
    for limb in _LIMBS:
        found = []
        for parts in limb:
            pairs = [(rigged.get(f"left{part}"), rigged.get(f"right{part}")) for part in parts]
            known = [(left, right) for left, right in pairs if left is not None and right is not None]
            joints, partners = ([pair[k] for pair in known] + [pair[1 - k] for pair in known] for k in (0, 1))
            for rest in rests if known else ():
                # With rest R, a parent's P: a partner's rotation q' is P^-1 P' q' R'^-1 R in the joint's own frame.
                before = rotations.multiply(rotations.inverse(rest[parents[joints]]), rest[parents[partners]])
                after = rotations.multiply(rotations.inverse(rest[partners]), rest[joints])
                shape = own[:, joints].shape
                exchanged = rotations.multiply(before.expand(shape), own[:, partners])
                exchanged = rotations.multiply(exchanged, after.expand(shape))
                runs = _find_swaps(own[:, joints], exchanged, ~hidden[:, joints])
                found += [(gain, start, stop, joints, exchanged) for gain, start, stop in runs]
        free = torch.ones(motion.num_frames, dtype=torch.bool)
        for _, start, stop, joints, exchanged in sorted(found, key=lambda run: -run[0]):
            if free[start:stop].all():
                free[start:stop] = False
                turns = rotations.turns_between(quats[start:stop, joints], exchanged[start:stop])
                degrees = math.degrees(float(turns.norm(dim=-1).max()))
                quats[start:stop, joints] = exchanged[start:stop]
                faults.append(Artefact(motion.skeleton.names[joints[0]], start, stop, "swap", degrees, "deg"))
    return (replace(motion, local_quat_xyzw=quats) if faults else motion), faults


def _find_swaps(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
) -> list[tuple[float, int, int]]:
    """Find runs of frames that are likelier exchanged, with the logarithm of how much likelier. Candidates lie between
    two frames from which on the exchanged rotations are nearer to the frame before."""
    same, other = ((1 - (each[1:] * captured[:-1]).sum(dim=-1).abs()).sum(dim=-1) for each in (captured, exchanged))
    turns = (other < same).nonzero()[:, 0].add(1).tolist()
    found = [(0.0, start, stop) for start in turns for stop in turns if 0 < stop - start <= _MOST_FRAMES]
    prior = math.log(SHARE / len(captured))  # one clip in a hundred has one
    for _ in range(_ROUNDS):  # what is likelier as captured is evidence for the rest
        if not found:
            break
        swapped = torch.zeros_like(seen[:, 0])
        for _, start, stop in found:
            swapped[start:stop] = True
        gains = _measure_gain(captured, exchanged, seen, swapped)
        gains = [(float(gains[start:stop].sum()) + prior, start, stop) for _, start, stop in found]
        found = [run for run in gains if run[0] > 0]
    return found


def _measure_gain(
    captured: Float[Tensor, "frames limb 4"],
    exchanged: Float[Tensor, "frames limb 4"],
    seen: Bool[Tensor, "frames limb"],
    swapped: Bool[Tensor, " frames"],
) -> Float[Tensor, " frames"]:
    """Return by how much the logarithm of the density of exchanged rotations is larger, given frames not swapped."""
    values = 2 * choose_continuous_signs(torch.where(swapped[:, None, None], exchanged, captured))
    values, centre = values - values.mean(dim=0), values.mean(dim=0)
    least = values.new_full((values.shape[1],), RESOLUTION)
    prediction = predict_frames(values, seen & ~swapped[:, None], least)
    densities = []
    for each in (exchanged, captured):
        errors = [(sign * 2 * each - centre - prediction.mean).norm(dim=-1) for sign in (1, -1)]
        likely = replace(prediction, error=torch.minimum(*errors)).log_density()
        densities.append(torch.logaddexp(likely, likely.new_tensor(_OUTLIER)))
    return (densities[0] - densities[1]).where(seen, 0.0).sum(dim=-1)
