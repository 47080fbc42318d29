"""In-betweening: a few keys to a whole motion that meets them. What a key tells is no unknown, so it is met to the bit;
where it only tells the place of a hand or a foot, the limb is bent until it is there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from controllers.inbetweening.feasibility import between_keys
from controllers.inbetweening.keyframes import lost_between, missed_by, targets_of
from controllers.inbetweening.pipeline import Infilled, InfillSettings, end_notes, fill
from controllers.inbetweening.proposers.answers import Another
from controllers.inbetweening.proposers.selection import choose_proposals
from mapctl.inbetweening.missing import Lost, straight
from mapctl.intent.keyframes import Key, Keys
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import RigMap, settled, to_canonical
from mapctl.retarget.rigs import Rig


def tween(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener | None,
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    rollable: Sequence[Any] = (),
    another: Another | None = None,
) -> Infilled:
    """A motion of the same length that goes through the keys of a motion, of which nothing else counts.

    Where keys are so far apart that the infiller does not know enough, one of the densities `rollable` proposes if a
    viewer would see less sliding (see `controllers.inbetweening.proposers.selection`); `another` takes the place of
    that choice. RequestError for keys that do not fit the motion or its rig; keys that nobody could reach in time get a
    note.
    """
    wanted = keys.checked(motion)
    canonical, rigmap, shown = shown_by(wanted, motion, rig)
    lost, targets = lost_between(wanted, motion, rigmap), targets_of(wanted, shown, rigmap)
    hasty = between_keys(shown, canonical, rigmap, lost, targets)
    if another is None and (settings is None or settings.method == "map"):
        another = partial(choose_proposals, densities=rollable)
    done = fill(
        motion,
        lost,
        infiller,
        settings=settings,
        densities=densities,
        rig=settled(rigmap),
        targets=targets,
        another=another,
    )
    by = "nearest key" if infiller is None else "infiller"
    return replace(done, notes=(*hasty, *end_notes(lost, by, by), *done.notes))


def shown_by(wanted: Sequence[Key], motion: Motion, rig: Rig | None) -> tuple[Motion, RigMap, Motion]:
    """All that counts, the keys and straight lines between them: on canonical joints, and on the rig, which is told
    from these, too.
    """
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[[key.frame for key in wanted if key.shown]] = False
    shown = straight(motion, Lost(free[:, None].expand(-1, motion.num_joints).clone(), free))
    return *to_canonical(shown, rig), shown


def key_errors(made: Motion, source: Motion, keys: Keys, rig: Rig | None = None) -> list[dict[str, Any]]:
    """By key, how far what it tells is missed (see `controllers.inbetweening.keyframes.missed_by`)."""
    return missed_by(made, source, keys, shown_by(keys.checked(source), source, rig)[1])
