"""Twins in mocap: windows of other clips between nearly the same two poses, whose distance is the freedom that motion
has there."""

from collections.abc import Sequence

from controllers.benchmarks.shared.tables import Row
from mapctl.inbetweening.retrieval import MotionCollection, bend_to_ends
from mapctl.motion import Motion

WITHIN = 0.08
"""Root mean square distance of the joints of both poses, metres, up to which windows are twins."""
_MOST = 8  # twins of one window


def measure_twins(clips: Sequence[Motion], windows: Sequence[Motion]) -> Row:
    """Measure the mean distance of joints between windows, from pose to pose, and their twins in other clips, the
    nearest of each, with ends bent to theirs; and count those that have some. Empty where none has.
    """
    collection, distances = MotionCollection.of(clips), []
    for window in windows:
        first, last = window.slice(0, 1), window.slice(window.num_frames - 1, window.num_frames)
        positions = window.joint_positions()
        # The nearest of all is the window itself.
        found = collection.find_nearest(first, last, window.num_frames - 1, _MOST + 1, within=WITHIN)
        twins = [bend_to_ends(each, first, last).joint_positions() for each in found]
        apart = [float((each - positions)[1:-1].norm(dim=-1).mean()) for each in twins]
        others = [each for each in apart if each > 1e-6]
        distances += [sum(others) / len(others)] if others else []
    if not distances:
        return {}
    return {"spread_cm": 100 * sum(distances) / len(distances), "twins": len(distances)}
