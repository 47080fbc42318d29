"""In-betweening: a few keys to a whole motion that meets them. What a key tells is no unknown, so it is met to the bit;
where it only tells the place of a hand or a foot, the limb is bent until it is there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from controllers.inbetweening.feasibility import check_keyframes
from controllers.inbetweening.keyframes import collect_effector_targets, keyframe_errors, missing_between_keys
from controllers.inbetweening.pipeline import InfillResult, InfillSettings, fill, note_open_ends
from controllers.inbetweening.proposers.answers import Proposer
from controllers.inbetweening.proposers.selection import choose_proposals
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.intent.keyframes import Key, Keys
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import RigMap, as_rig, to_canonical
from mapctl.retarget.rigs import Rig


def tween(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener | None,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    rig: Rig | None = None,
    rollout_densities: Sequence[Density] = (),
    another: Proposer | None = None,
) -> InfillResult:
    """A motion of the same length that goes through the keys of a motion, of which nothing else counts.

    Where keys are so far apart that the infiller does not know enough, one of `rollout_densities` proposes if a viewer
    would see less sliding (see `controllers.inbetweening.proposers.selection`); `another` takes the place of
    that choice. RequestError for keys that do not fit the motion or its rig; keys that nobody could reach in time get a
    note.
    """
    wanted = keys.checked(motion)
    canonical, rigmap, shown = keyframe_motion(wanted, motion, rig)
    lost, targets = missing_between_keys(wanted, motion, rigmap), collect_effector_targets(wanted, shown, rigmap)
    hasty = check_keyframes(shown, canonical, rigmap, lost, targets)
    if another is None and (settings is None or settings.method == "map"):
        another = partial(choose_proposals, densities=rollout_densities)
    done = fill(
        motion,
        lost,
        infiller,
        settings=settings,
        densities=densities,
        rig=as_rig(rigmap),
        targets=targets,
        another=another,
    )
    by = "nearest key" if infiller is None else "infiller"
    return replace(done, notes=(*hasty, *note_open_ends(lost, by, by), *done.notes))


def keyframe_motion(wanted: Sequence[Key], motion: Motion, rig: Rig | None) -> tuple[Motion, RigMap, Motion]:
    """All that counts, the keys and straight lines between them: on canonical joints, and on the rig, which is told
    from these, too.
    """
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[[key.frame for key in wanted if key.shown]] = False
    shown = interpolate_missing(motion, MissingMask(free[:, None].expand(-1, motion.num_joints).clone(), free))
    return *to_canonical(shown, rig), shown


def measure_keyframe_errors(made: Motion, source: Motion, keys: Keys, rig: Rig | None = None) -> list[dict[str, Any]]:
    """By key, how far what it tells is missed (see `controllers.inbetweening.keyframes.keyframe_errors`)."""
    return keyframe_errors(made, source, keys, keyframe_motion(keys.checked(source), source, rig)[1])
