"""Benchmark of retracing: clips walked in place, as on a treadmill, get their way back through the whole job, on rigid
bones and with planted feet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.infill import retraced
from mapctl.features import PRIOR_FPS
from mapctl.metrics import feet
from mapctl.metrics.feet import ToeMeasurements
from mapctl.metrics.root_prediction import average_displacement_errors
from mapctl.motion import Motion
from mapctl.protocols import PathPredictor
from mapctl.recording.masks import ROOT, Mask
from mapctl.skeleton import TOE_JOINTS

_LEAST_FRAMES = 2 * PRIOR_FPS


def benchmark_walked_in_place(kinds: Mapping[str, Sequence[Motion]], path: PathPredictor) -> list[Row]:
    """Measure by kind of clip, two seconds at least: errors of displacements, cm, and the speed of toes in frames in
    which mocap's are planted (cm/s), beside mocap's own. Clips are on canonical joints.
    """
    rows = []
    for kind, clips in kinds.items():
        whole = [clip for clip in map(scale_to_canonical_bones, clips) if clip.num_frames >= _LEAST_FRAMES]
        found = [measure_walked_in_place(clip, path) for clip in whole]
        if found:
            columns = {name: [row[name] for row in found if name in row] for name in found[0]}
            means = {name: sum(each) / len(each) for name, each in columns.items()}
            rows.append({"kind": kind, "clips": len(found), "by": "ours, in place", **means})
    return rows


def measure_walked_in_place(clip: Motion, path: PathPredictor) -> Row:
    """Measure one clip of unit size at PRIOR_FPS whose way over the ground is taken away."""
    up = torch.tensor([0.0, 1.0, 0.0], dtype=clip.root_position.dtype)
    in_place = replace(clip, root_position=clip.root_position * up)
    found = retraced(in_place, path, [Mask(ROOT, 0, clip.num_frames)]).motion
    errors = average_displacement_errors(found.root_position[:, ::2], clip.root_position[:, ::2], [1, 8, 32, 64])
    ours, mocap = (_measure_toes(each) for each in (found, clip))
    return {
        **{f"{name}_cm": value for name, value in errors.items()},
        "Y_cm": 100 * float((found.root_position - clip.root_position)[:, 1].abs().mean()),
        "planted_cm_s": 100 * feet.contact_speed(replace(ours, planted=mocap.planted)),
        "mocap_cm_s": 100 * feet.contact_speed(mocap),
    }


def _measure_toes(clip: Motion) -> ToeMeasurements:
    return ToeMeasurements.of(clip.joint_positions()[:, list(TOE_JOINTS)], float(clip.fps))
