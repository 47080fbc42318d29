"""In-betweening of keyframes. What a key gives is no unknown, so it is met to the bit; where it gives only the position
of a hand or a foot, the limb is bent to reach it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from controllers.inbetweening.feasibility import check_keyframes, note_joint_ranges
from controllers.inbetweening.keyframes import (
    collect_effector_targets,
    collect_loose_keys,
    keyframe_errors,
    missing_between_keys,
)
from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.solution import InbetweenSolution
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.intent.keyframes import Key, Keys
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import RigMap, as_rig, identify_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.terms import Term


def tween(
    motion: Motion,
    keys: Keys,
    inbetweener: Inbetweener,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    generator: torch.Generator | None = None,
) -> InbetweenSolution:
    """Make a motion of the same length through the keys of a motion, of which all else is ignored.

    Of `densities` the likeliest joins the MAP stage, and so do `terms`; all sampling is from the generator.
    RequestError for keys that do not fit the motion or its rig; keys that no body could meet in time are named in the
    status, which is then infeasible.
    """
    wanted = keys.checked(motion)
    canonical, rigmap, shown = keyframe_motion(wanted, motion, rig)
    missing, targets = missing_between_keys(wanted, motion, rigmap), collect_effector_targets(wanted, shown, rigmap)
    loose = collect_loose_keys(wanted, motion, rigmap)
    infeasible = check_keyframes(shown, canonical, rigmap, missing, targets, loose)
    done = fill(
        motion,
        missing,
        inbetweener,
        settings=settings,
        densities=densities,
        terms=terms,
        rig=as_rig(rigmap),
        targets=targets,
        loose=loose,
        generator=generator,
    )
    beyond = note_joint_ranges(canonical, missing, rigmap)
    status = done.status.with_notes(beyond)
    return replace(done, status=status.with_notes(infeasible, infeasible=bool(infeasible)))


def keyframe_motion(wanted: Sequence[Key], motion: Motion, rig: Rig | None) -> tuple[Motion, RigMap, Motion]:
    """Return the keys with an interpolation between them: on canonical joints, with the map of the rig, which is
    identified from these, and on the rig.
    """
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    # Where keys tell no rotation at all, the rig is known by the pose at any of them.
    free[[key.frame for key in wanted if key.shown] or [wanted[0].frame]] = False
    shown = interpolate_missing(motion, MissingMask.of_frames(free, motion.num_joints))
    canonical, rigmap = to_canonical(shown, rig)
    unseen = missing_between_keys(wanted, motion, rigmap).joints.all(dim=0)
    if rigmap.tpose_doubt and bool(unseen.any()):  # joints that no key gives are no evidence of how the rig is built
        rested = shown.local_quat_xyzw.clone()
        rested[:, unseen] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rested.dtype)
        known = identify_rig(motion.skeleton, rig, motion=replace(shown, local_quat_xyzw=rested))
        canonical, rigmap = to_canonical(shown, known)
    return canonical, rigmap, shown


def measure_keyframe_errors(made: Motion, source: Motion, keys: Keys, rig: Rig | None = None) -> list[dict[str, Any]]:
    """Measure by key how far what it gives is missed (see `controllers.inbetweening.keyframes.keyframe_errors`)."""
    return keyframe_errors(made, source, keys, keyframe_motion(keys.checked(source), source, rig)[1])
