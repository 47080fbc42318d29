"""Benchmark of path predictors (Zhou et al. 2020, table 2): how far off the trajectory of the hips is that is told by
the body alone, after so many frames, by kind of clip.
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.proposers.retraced import predict_trajectory
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.kinematics import heading
from mapctl.metrics.root_prediction import SPANS, average_displacement_errors
from mapctl.motion import Motion
from mapctl.protocols import PathPredictor
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT

_ALL = "all clips"


class StillPath(PathPredictor):
    """Baseline: the hips stay where they are, as high as in the rest pose."""

    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Predict no steps."""
        rest = _rest_height(CANONICAL.offsets)
        height = torch.full_like(motion.turns, rest)
        return RootTrajectory(motion.places[..., 0, ::2] * 0, height, _no_contacts(motion))


class AnchoredToePath(PathPredictor):
    """Baseline: from frame to frame the lower toe stays where it is, and stands on the floor."""

    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Predict the steps that keep the toe in its place that is lower in both frames."""
        toes = motion.places[..., list(TOE_JOINTS), :]
        before = torch.cat([toes[:, :1], toes[:, :-1]], dim=1)
        lower = (before + toes)[..., 1].argmin(dim=-1)
        steps = motion.anchored_steps()[..., list(TOE_JOINTS), ::2]
        chosen = torch.take_along_dim(steps, lower[..., None, None], dim=-2)[..., 0, :]
        height = TOE_REST_HEIGHT - toes[..., 1].amin(dim=-1)
        return RootTrajectory(chosen, height, _no_contacts(motion))


def benchmark_root_prediction(kinds: Mapping[str, Sequence[Motion]], path: PathPredictor) -> list[Row]:
    """Measure the trajectory over every frame of clips by kind, for the predictor and two baselines: mean error of the
    displacement over 1 to 64 frames (V1 to V64, cm) and of the height (Y, cm). Clips are on canonical joints and count
    alike; the last rows are over all of them.
    """
    methods: Mapping[str, PathPredictor] = {"still": StillPath(), "toe anchored": AnchoredToePath(), "ours": path}
    clips = {kind: [scale_to_canonical_bones(clip) for clip in found] for kind, found in kinds.items()}
    rows = []
    measured: dict[str, list[Row]] = {name: [] for name in methods}
    for kind, found in clips.items():
        for name, method in methods.items():
            each = [measure_root_prediction(clip, method) for clip in found]
            measured[name] += each
            rows.append({"kind": kind, "clips": len(each), "by": name, **_average(each)})
    return [
        *rows,
        *({"kind": _ALL, "clips": len(each), "by": name, **_average(each)} for name, each in measured.items()),
    ]


def measure_root_prediction(clip: Motion, path: PathPredictor) -> Row:
    """Measure one clip of unit size; spans that it is too short for are left out."""
    predicted = predict_trajectory(clip, path)
    found = predicted.integrate(heading(clip.local_quat_xyzw[:, 0]).float()[None])[0].double()
    errors = average_displacement_errors(found[:, ::2], clip.root_position[:, ::2])
    return {**errors, "Y": 100 * float((found[:, 1] - clip.root_position[:, 1]).abs().mean())}


def _average(rows: Sequence[Row]) -> Row:
    """Average each column over the clips that have it."""
    columns = [f"V{span}" for span in SPANS] + ["Y"]
    found = {name: [row[name] for row in rows if name in row] for name in columns}
    return {f"{name}_cm": sum(each) / len(each) if each else float("nan") for name, each in found.items()}


def _rest_height(offsets: Float[Tensor, "joints 3"]) -> float:
    """Return the height of the hips in the rest pose, metres."""
    height, joint = TOE_REST_HEIGHT, TOE_JOINTS[0]
    while joint:
        height -= float(offsets[joint, 1])
        joint = CANONICAL.parents[joint]
    return height


def _no_contacts(motion: LocalMotion) -> Float[Tensor, "batch frames 2"]:
    return torch.zeros(*motion.turns.shape, 2)
