"""Editing of motions on their own rigs: mirrored, planted, looped, on the spot, or with travel on the root joint."""

from mapctl.editing.looping import Cycle, Loop, close_loop, describe_cycle, find_cycle, plant_feet
from mapctl.editing.mirroring import mirror
from mapctl.editing.travel import GroundTransform, move_travel_to_root, remove_travel

__all__ = [
    "Cycle",
    "GroundTransform",
    "Loop",
    "close_loop",
    "describe_cycle",
    "find_cycle",
    "mirror",
    "move_travel_to_root",
    "plant_feet",
    "remove_travel",
]
