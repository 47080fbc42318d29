"""Benchmark of infilling (Kaufmann et al. 2020, tables 1 and 2, figure 5, and its study of gap and context): gaps in
held-out clips, filled by raw networks, on rigid bones, by MAP, and by interpolation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener, SlerpInbetweener
from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.interpolation import interpolate_heading, interpolate_positions
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener, PositionInfiller
from mapctl.recording.masks import ALL, Mask
from mapctl.skeleton import CANONICAL, TOE_JOINTS, leg_length

WINDOW_FRAMES = 120
"""Frames of a clip that are used: 4 s as in Kaufmann et al. 2020."""
_GAP_CONTEXT_FRAMES = 40  # frames on either side while the gap's length is varied
_UNFINISHED = InfillSettings(finish=False)
_MEASURED_BONES = tuple(
    CANONICAL.index(side + part) for side in ("left", "right") for part in ("LowerArm", "Hand", "Foot")
)


@dataclass(frozen=True, eq=False)
class Task:
    """A corruption of a clip that is to be undone."""

    name: str
    """Name in the table."""
    frames: int
    """Frames of the clip that are used, from its middle."""
    gap: int = 0
    """Frames of the gap in their middle."""
    noise: float = 0.0
    """Sigma of the noise of every coordinate of every joint, metres."""
    dropout: float = 0.0
    """Share of joints that are missing in every frame."""


TASKS: tuple[Task, ...] = (
    Task("nothing missing", WINDOW_FRAMES),
    Task("gap of 0.5 s", WINDOW_FRAMES, 15),
    Task("gap of 1 s", WINDOW_FRAMES, 30),
    Task("gap of 2 s", WINDOW_FRAMES, 60),
    Task("noise of 3 cm", WINDOW_FRAMES, noise=0.03),
    Task("noise of 5 cm", WINDOW_FRAMES, noise=0.05),
    Task("30 % of joints dropped", WINDOW_FRAMES, dropout=0.3),
    Task("50 % of joints dropped", WINDOW_FRAMES, dropout=0.5),
    *(
        Task(f"gap of {gap} frames, {_GAP_CONTEXT_FRAMES} around it", gap + 2 * _GAP_CONTEXT_FRAMES, gap)
        for gap in (3, 10, 40, 125)
    ),
    *(Task(f"gap of 40 frames, {context} around it", 40 + 2 * context, 40) for context in (1, 3, 5, 13, 25)),
)
"""Tasks of Kaufmann et al. 2020, at 30 frames/s instead of 60; the paper gives its noise without a unit."""


def benchmark_infilling(
    clips: Sequence[Motion],
    networks: Mapping[str, PositionInfiller],
    *,
    ours: str,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure every task for every method, over all clips that are long enough, if there are any; `ours` is the network
    that MAP refines.

    Root-aligned joint error over what was missing (over everything where nothing was), cm, mean and standard deviation
    over joints and frames; deviation of six bones' lengths, mm. Clips are on canonical joints.
    """
    rows = []
    clips = [scale_to_canonical_bones(clip) for clip in clips]
    for number, task in enumerate(TASKS):
        shown = [slice_middle(clip, task.frames) for clip in clips if clip.num_frames >= task.frames]
        done = _evaluate_task(task, shown, networks, ours) if shown else []
        rows += [{"task": task.name, "clips": len(shown), **row} for row in done]
        if progress is not None:
            progress(number + 1, len(TASKS))
    return rows


def benchmark_infilling_by_kind(kinds: Mapping[str, Sequence[Motion]], infiller: Inbetweener) -> list[Row]:
    """Measure gaps of 0.5, 1 and 2 s by kind of clip: error of slerp and of MAP, cm, and their ratio, which is the mean
    of the clips' own, so that all clips count alike.
    """
    rows = []
    for kind, clips in kinds.items():
        for task in TASKS[1:4]:
            long = [clip for clip in clips if clip.seconds * PRIOR_FPS > WINDOW_FRAMES]
            shown = [slice_middle(scale_to_canonical_bones(clip), WINDOW_FRAMES) for clip in long]
            masks = [Mask(ALL, (WINDOW_FRAMES - task.gap) // 2, (WINDOW_FRAMES + task.gap) // 2)]
            pairs = [
                [
                    float(_evaluate_infill(clip, masks, by, settings).errors.mean())
                    for by, settings in ((SlerpInbetweener(), _UNFINISHED), (AutoInbetweener(infiller), None))
                ]
                for clip in shown
            ]
            if pairs:
                errors = 100 * torch.tensor(pairs)
                slerp, ours = errors.mean(dim=0).tolist()
                row = {"task": task.name, "clips": len(pairs), "method": f"MAP on {kind}"}
                ratio = float((errors[:, 1] / errors[:, 0]).mean())
                rows.append({**row, "error_cm": ours, "slerp_cm": slerp, "ratio": ratio})
    return rows


def _evaluate_task(
    task: Task, clips: Sequence[Motion], networks: Mapping[str, PositionInfiller], ours: str
) -> list[Row]:
    """Measure one row for each method."""
    rows = []
    for name, network in networks.items():
        done = [
            _evaluate_network(clip, task, network, torch.Generator().manual_seed(n)) for n, clip in enumerate(clips)
        ]
        rows.append({"method": f"{name}, raw", **_summarise_clip_errors(done)})
    if task.gap:
        masks = [Mask(ALL, (task.frames - task.gap) // 2, (task.frames + task.gap) // 2)]
        methods = (
            (f"{ours}, on rigid bones", networks[ours], _UNFINISHED),
            (f"{ours}, and MAP", AutoInbetweener(networks[ours]), None),
            ("interpolation", SlerpInbetweener(), _UNFINISHED),
        )
        for name, inbetweener, settings in methods:
            done = [_evaluate_infill(clip, masks, inbetweener, settings) for clip in clips]
            rows.append({"method": name, **_summarise_clip_errors(done)})
    return rows


@dataclass(frozen=True, eq=False)
class _ClipErrors:
    """Errors of one clip."""

    errors: Float[Tensor, " missing"]
    """Errors of every joint and frame that counts, metres."""
    bones: Float[Tensor, " lengths"]
    """Deviations of bones from their lengths, metres."""


def _evaluate_network(clip: Motion, task: Task, network: PositionInfiller, generator: torch.Generator) -> _ClipErrors:
    """Measure a network's raw positions."""
    truth = clip.joint_positions().float()
    known = _sample_observation_mask(task, generator)
    observed = truth + task.noise * torch.randn(truth.shape, generator=generator)
    facing = heading(clip.local_quat_xyzw[:, 0]).float()
    planted = contacts.detect_contacts(truth[:, list(TOE_JOINTS)], PRIOR_FPS).float()
    interpolated = interpolate_positions(observed[None], clip.local_quat_xyzw.float()[None], known[None])
    image = PositionImage.of_world(
        interpolated,
        interpolate_heading(facing[None], known[None]),
        planted[None],
        known=known[None],
        present=torch.ones(1, len(truth), dtype=torch.bool),
        toes=TOE_JOINTS,
    )
    positions = image.to_world(network.complete(image).places)[0]
    return _measure_errors(positions, truth, ~known if bool((~known).any()) else torch.ones_like(known))


def _evaluate_infill(
    clip: Motion, masks: Sequence[Mask], inbetweener: Inbetweener, settings: InfillSettings | None
) -> _ClipErrors:
    """Measure an infilled motion on rigid bones."""
    positions = infill(clip, inbetweener, masks, settings=settings).motion.joint_positions()
    missing = torch.zeros(positions.shape[:2], dtype=torch.bool)
    missing[masks[0].start : masks[0].stop] = True
    return _measure_errors(positions, clip.joint_positions(), missing)


def _measure_errors(positions: Tensor, truth: Tensor, missing: Bool[Tensor, "frames joints"]) -> _ClipErrors:
    difference = (positions - positions[:, :1]) - (truth - truth[:, :1])
    above = [CANONICAL.parents[bone] for bone in _MEASURED_BONES]
    lengths = (positions[:, list(_MEASURED_BONES)] - positions[:, above]).norm(dim=-1)
    length_errors = lengths - CANONICAL.offsets[list(_MEASURED_BONES)].norm(dim=-1).to(lengths)
    return _ClipErrors(difference.norm(dim=-1)[missing], length_errors[missing.any(dim=1)].flatten().abs())


def _sample_observation_mask(task: Task, generator: torch.Generator) -> Bool[Tensor, "frames joints"]:
    known = torch.rand(task.frames, CANONICAL.num_joints, generator=generator) >= task.dropout
    start = (task.frames - task.gap) // 2
    known[start : start + task.gap] = False
    return known


def _summarise_clip_errors(results: Sequence[_ClipErrors]) -> Row:
    errors, bones = (torch.cat([getattr(result, name) for result in results]) for name in ("errors", "bones"))
    return {
        "error_cm": 100 * float(errors.mean()),
        "std_cm": 100 * float(errors.std()),
        "bones_mm": 1000 * float(bones.mean()),
    }


def scale_to_canonical_bones(motion: Motion) -> Motion:
    """Return a canonical motion at the prior's rate on the canonical skeleton, scaled by leg length."""
    motion = motion.resample(PRIOR_FPS)
    scale = leg_length(motion.skeleton) / leg_length(CANONICAL)
    return Motion(CANONICAL, motion.fps, motion.root_position / scale, motion.local_quat_xyzw)


def slice_middle(motion: Motion, frames: int) -> Motion:
    """Return so many frames from the middle of a motion that has them."""
    start = (motion.num_frames - frames) // 2
    return motion.slice(start, start + frames)
