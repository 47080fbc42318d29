"""What infilling is worth (infilling paper, tables 1 and 2, figure 5, and its study of gap and context): clips that no
training saw, with pieces taken out, filled by networks as they are, on rigid bones, by MAP, and by interpolation.
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
"""Frames of a clip that are looked at: the paper's 4 s."""
_GAP_CONTEXT_FRAMES = 40  # frames on either side while the gap's length is varied
_UNFINISHED = InfillSettings(finish=False)
_MEASURED_BONES = tuple(
    CANONICAL.index(side + part) for side in ("left", "right") for part in ("LowerArm", "Hand", "Foot")
)


@dataclass(frozen=True, eq=False)
class Task:
    """What is taken out of a clip."""

    name: str
    """In the table."""
    frames: int
    """Of the piece of a clip that is shown, from its middle."""
    gap: int = 0
    """Frames that are taken out of its middle."""
    noise: float = 0.0
    """Of every coordinate of every joint, metres."""
    dropout: float = 0.0
    """Share of joints taken out of every frame."""


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
"""The paper's, at 30 frames a second in place of its 60; its noise is said in no unit, ours is."""


def benchmark_infilling(
    clips: Sequence[Motion],
    networks: Mapping[str, PositionInfiller],
    *,
    ours: str,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Every task for every method, over all clips that are long enough, if there are any; `ours` is the network that
    MAP finishes.

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
    """Gaps of 0.5, 1 and 2 s by kind of clip: error of slerp and of MAP, cm, and their ratio. A longer and more lively
    clip counts no more than another: the ratio is the mean of the clips' own.
    """
    rows = []
    for kind, clips in kinds.items():
        for task in TASKS[1:4]:
            shown = [
                slice_middle(scale_to_canonical_bones(clip), WINDOW_FRAMES)
                for clip in clips
                if clip.seconds * PRIOR_FPS > WINDOW_FRAMES
            ]
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
                rows.append(
                    {
                        "task": task.name,
                        "clips": len(pairs),
                        "method": f"MAP on {kind}",
                        "error_cm": ours,
                        "slerp_cm": slerp,
                        "ratio": float((errors[:, 1] / errors[:, 0]).mean()),
                    }
                )
    return rows


def _evaluate_task(
    task: Task, clips: Sequence[Motion], networks: Mapping[str, PositionInfiller], ours: str
) -> list[Row]:
    """One row a method."""
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
    """Of one clip."""

    errors: Float[Tensor, " missing"]
    """Of every joint and frame that counts, metres."""
    bones: Float[Tensor, " lengths"]
    """Deviations of bones from their lengths, metres."""


def _evaluate_network(clip: Motion, task: Task, network: PositionInfiller, generator: torch.Generator) -> _ClipErrors:
    """A network's places as they are."""
    truth = clip.joint_positions().float()
    known = _sample_observation_mask(task, generator)
    seen = truth + task.noise * torch.randn(truth.shape, generator=generator)
    facing = heading(clip.local_quat_xyzw[:, 0]).float()
    stands = contacts.detect_contacts(truth[:, list(TOE_JOINTS)], PRIOR_FPS).float()
    guess = interpolate_positions(seen[None], clip.local_quat_xyzw.float()[None], known[None])
    image = PositionImage.of_world(
        guess,
        interpolate_heading(facing[None], known[None]),
        stands[None],
        known=known[None],
        present=torch.ones(1, len(truth), dtype=torch.bool),
        toes=TOE_JOINTS,
    )
    places = image.to_world(network.complete(image).places)[0]
    return _measure_errors(places, truth, ~known if bool((~known).any()) else torch.ones_like(known))


def _evaluate_infill(
    clip: Motion, masks: Sequence[Mask], inbetweener: Inbetweener, settings: InfillSettings | None
) -> _ClipErrors:
    """A whole motion of rigid bones."""
    places = infill(clip, inbetweener, masks, settings=settings).motion.joint_positions()
    missing = torch.zeros(places.shape[:2], dtype=torch.bool)
    missing[masks[0].start : masks[0].stop] = True
    return _measure_errors(places, clip.joint_positions(), missing)


def _measure_errors(places: Tensor, truth: Tensor, missing: Bool[Tensor, "frames joints"]) -> _ClipErrors:
    wrong = (places - places[:, :1]) - (truth - truth[:, :1])
    above = [CANONICAL.parents[bone] for bone in _MEASURED_BONES]
    lengths = (places[:, list(_MEASURED_BONES)] - places[:, above]).norm(dim=-1)
    away = lengths - CANONICAL.offsets[list(_MEASURED_BONES)].norm(dim=-1).to(lengths)
    return _ClipErrors(wrong.norm(dim=-1)[missing], away[missing.any(dim=1)].flatten().abs())


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
    """A canonical motion at the prior's rate, on the canonical skeleton, in scale."""
    motion = motion.resample(PRIOR_FPS)
    scale = leg_length(motion.skeleton) / leg_length(CANONICAL)
    return Motion(CANONICAL, motion.fps, motion.root_position / scale, motion.local_quat_xyzw)


def slice_middle(motion: Motion, frames: int) -> Motion:
    """So many frames from the middle of a motion that has them."""
    start = (motion.num_frames - frames) // 2
    return motion.slice(start, start + frames)
