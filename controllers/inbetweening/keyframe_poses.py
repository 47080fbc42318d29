"""Poses of a key file as a motion on one body and its keys: poses are read, positioned, oriented, and retargeted to the
body's rig where they come from another.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch

from controllers.inbetweening.keyframes import effector_joint, resolve_drawing
from mapctl import formats, rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.inbetweening.pose_pairs import (
    TRAVELLING_DISTANCE,
    TimingModel,
    compute_pair_features,
    compute_pose_distance,
    compute_travel_distance,
)
from mapctl.intent.keyframe_toml import KeyEntry, KeyRequest, read_drawing
from mapctl.intent.keyframes import Key, Keys
from mapctl.kinematics import heading
from mapctl.motion import Motion, join_licences
from mapctl.retarget import RigMap, as_rig, from_canonical, to_canonical
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, leg_length


@dataclass(frozen=True, eq=False)
class KeyframeClip:
    """Motion and keys as `tween` takes them."""

    motion: Motion
    """Motion on the body's rig, at the requested rate: the poses at their keys, interpolated between them."""
    keys: Keys
    """Keys of the motion."""
    rig: Rig | None
    """The body's rig, where it is known."""


def build_keyframe_clip(
    request: KeyRequest, rig: Rig | None = None, on_read: Callable[[Path, Motion, Rig | None], None] | None = None
) -> KeyframeClip:
    """Build the motion and the keys of a request. RequestError, which names the key, for poses and joints that do not
    exist; `rig` is the body's where it is not the one that would be recognised. `on_read` is called with each file that
    is read, its motion and its rig.
    """
    first = next((number for number, key in enumerate(request.key) if key.pose is not None), 0)
    reader = _PoseReader(rig, on_read)
    with _prefix_errors("body" if request.body is not None else f"key[{first}].pose"):
        body = reader.body(request.body or request.key[first].pose or "")
    fps = Fraction(request.fps).limit_denominator(100_000)
    keys, poses = {}, {}
    for number, key in enumerate(request.key):
        frame = request.frame_of(key)
        keys[frame] = _build_key(key, frame, body.rigmap, number)
        if key.needs_pose or key.tells_place:
            poses[frame] = replace(_build_pose(key, request, reader, body, number), fps=fps, source=body.clip.source)
    motion = replace(_interpolate_poses(poses, max(keys) + 1), licence=reader.licence)
    return KeyframeClip(motion, Keys(tuple(keys.values())), as_rig(body.rigmap))


@dataclass(frozen=True, eq=False)
class _LoadedClip:
    """Motion of a file, as read and retargeted."""

    path: str
    """The file."""
    clip: Motion
    """Clip as read."""
    canonical: Motion
    """Clip on canonical joints, with the bones of the body and on its floor."""
    target_body: RiggedCharacter
    """The body."""

    @property
    def rigmap(self) -> RigMap:
        """Map from canonical joints to the body's rig."""
        return self.target_body.rigmap


@dataclass(eq=False)
class _PoseReader:
    """Reader that loads every file once."""

    rig: Rig | None
    """Rig of the body."""
    on_read: Callable[[Path, Motion, Rig | None], None] | None
    """Function called with each file, its motion and its rig."""
    clips: dict[str, _LoadedClip] = field(default_factory=dict)
    """Loaded clips by path."""

    @property
    def licence(self) -> str:
        """Licences of all loaded clips."""
        return join_licences(each.clip.licence for each in self.clips.values())

    def body(self, path: str) -> _LoadedClip:
        """Load the body's own file, on its rig where one is given."""
        clip = self._load(path, self.rig)
        self.clips[path] = _LoadedClip(path, clip, *RiggedCharacter.of(clip, self.rig))
        return self.clips[path]

    def pose(self, path: str, body: _LoadedClip) -> _LoadedClip:
        """Load a clip, retargeted to the body; the rig of another skeleton must be recognised."""
        if path not in self.clips:
            clip = self._load(path, None)
            moved = retarget_motion(clip, body.target_body).motion
            self.clips[path] = _LoadedClip(path, clip, moved, body.target_body)
        return self.clips[path]

    def _load(self, path: str, rig: Rig | None) -> Motion:
        clip = formats.load(Path(path), metres_per_unit=None if rig is None else rig.metres_per_unit)
        if self.on_read is not None:
            self.on_read(Path(path), clip, rig)
        return clip


def _build_key(key: KeyEntry, frame: int, rigmap: RigMap, number: int) -> Key:
    for name, names in (("joints", key.joints), ("reach", tuple(key.reach))):
        with _prefix_errors(f"key[{number}].{name}"):
            for joint in names:
                effector_joint(joint, rigmap)
    drawing = None
    if key.drawing is not None:
        with _prefix_errors(f"key[{number}].drawing"):
            drawing = read_drawing(key.drawing, key.view_deg or 0.0)
            resolve_drawing(drawing, rigmap)
    placed = drawing is not None and key.place is not None
    kind: Literal["place"] | bool = "place" if key.root_only == "place" else bool(key.root_only)
    return Key(frame, key.joints, key.reach, root_only=kind, half=key.half, drawing=drawing, placed=placed)


def _build_pose(key: KeyEntry, request: KeyRequest, reader: _PoseReader, body: _LoadedClip, number: int) -> Motion:
    """Build one frame on the body's rig, at its requested position and heading; of a key that tells a place alone, any
    pose of the body's there."""
    with _prefix_errors(f"key[{number}].pose"):
        found = reader.pose(key.pose or request.body or body.path, body)
    clip = found.clip
    frame = key.pose_frame or 0
    if key.pose_seconds is not None:
        frame = round(key.pose_seconds * float(clip.fps))
    if frame >= clip.num_frames:
        name = "pose_frame" if key.pose_seconds is None else "pose_seconds"
        raise RequestError(f"key[{number}].{name}: the frame {frame} is not one of the pose's 0:{clip.num_frames}")
    own, canonical = clip.slice(frame, frame + 1), found.canonical.slice(frame, frame + 1)
    same = clip.skeleton.matches(body.clip.skeleton)
    if same and key.place is None and key.height is None and key.facing_deg is None:
        return own
    placed = _position_pose(replace(canonical, source=None), key)
    return from_canonical(placed, body.rigmap, own if same else None)


def _position_pose(pose: Motion, key: KeyEntry) -> Motion:
    """Set a canonical pose's position on the ground, its height and its heading."""
    root, quats = pose.root_position.clone(), pose.local_quat_xyzw.clone()
    if key.place is not None:
        root[0, 0], root[0, 2] = key.place
    if key.height is not None:
        root[0, 1] = key.height
    if key.facing_deg is not None:
        turn = torch.deg2rad(torch.tensor([key.facing_deg], dtype=torch.float64)) - heading(quats[:, 0])
        quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    return replace(pose, root_position=root, local_quat_xyzw=quats)


def _interpolate_poses(poses: dict[int, Motion], frames: int) -> Motion:
    """Interpolate from pose to pose between their frames."""
    at = torch.tensor(sorted(poses))
    joined = reduce(Motion.join, (poses[frame] for frame in sorted(poses)))
    source = (torch.searchsorted(at, torch.arange(frames), right=True) - 1).clamp_min(0)
    moving = {joint: values[source] for joint, values in joined.moving_offsets.items()}
    motion = replace(
        joined,
        root_position=joined.root_position[source],
        moving_offsets=moving,
        local_quat_xyzw=rotations.make_sign_continuous(joined.local_quat_xyzw)[source],
    )
    free = torch.ones(frames, dtype=torch.bool)
    free[at] = False
    return interpolate_missing(motion, MissingMask.of_frames(free, motion.num_joints))


@contextmanager
def _prefix_errors(where: str) -> Iterator[None]:
    """Prefix errors raised within by the key of the request."""
    try:
        yield
    except MapctlError as error:
        raise RequestError(f"{where}: {error}") from error


@dataclass(frozen=True)
class KeyInterval:
    """Interval between two neighbouring keyframes that are whole poses."""

    start: int
    """Frame of the first keyframe."""
    stop: int
    """Frame of the second keyframe."""
    suggested: int
    """Median number of frames between such poses in mocap."""
    usual: tuple[int, int]
    """Numbers of frames between which four of five of mocap's pairs lie."""
    metres: float
    """Distance of the hips over the ground, on this body, metres."""
    given_speed: float
    """Mean speed over this distance with the given timing, m/s."""
    suggested_speed: float
    """Mean speed over this distance with the suggested timing, m/s."""
    pose_distance_cm: float
    """Mean distance of the joints relative to the hips, cm."""

    @property
    def given(self) -> int:
        """Given number of frames between the keyframes."""
        return self.stop - self.start

    @property
    def reason(self) -> str:
        """Reason for the suggestion, with numbers."""
        low, high = self.usual
        verdict = "short" if self.given < low else "long" if self.given > high else "usual"
        if self.metres < TRAVELLING_DISTANCE:
            return (
                f"{verdict}: about in place ({self.metres:.2f} m), joints {self.pose_distance_cm:.0f} cm apart; mocap "
                f"mostly takes {low} to {high} frames"
            )
        return (
            f"{verdict}: {self.metres:.2f} m at {self.given_speed:.2f} m/s, where poses like these go at "
            f"{self.suggested_speed:.2f} m/s; mocap mostly takes {low} to {high} frames"
        )

    def summary(self) -> dict[str, Any]:
        """Return the interval as a report's JSON has it."""
        return {
            "from": self.start,
            "to": self.stop,
            "given": self.given,
            "suggested": self.suggested,
            "usual": list(self.usual),
            "metres": self.metres,
            "given_m_s": self.given_speed,
            "suggested_m_s": self.suggested_speed,
            "apart_cm": self.pose_distance_cm,
            "reason": self.reason,
        }


def suggest_intervals(motion: Motion, keys: Keys, timing: TimingModel, rig: Rig | None = None) -> list[KeyInterval]:
    """Suggest the time between neighbouring keyframes that are whole poses; others may lie between. RequestError for
    keys that do not fit the motion, and for fewer than two such poses.
    """
    key_frames = [key.frame for key in keys.checked(motion) if key.what == "pose"]
    if len(key_frames) < 2:
        raise RequestError(f"timing is suggested between whole poses; the keys have {len(key_frames)}, it takes two")
    canonical = to_canonical(_select_frames(motion, key_frames), rig)[0]
    scale, fps = leg_length(canonical.skeleton) / leg_length(CANONICAL), float(motion.fps)
    body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    first = torch.arange(len(key_frames) - 1)
    distances = compute_travel_distance(body, first, first + 1)
    quantiles = (fps * timing.estimate_seconds(compute_pair_features(body, first, first + 1), distances)).tolist()
    metres = (scale * distances).tolist()
    pose_distances = (100 * scale * compute_pose_distance(body, first, first + 1)).tolist()
    intervals = []
    each = zip(pairwise(key_frames), quantiles, metres, pose_distances, strict=True)
    for (start, stop), counts, distance, pose_distance in each:
        low, suggested, high = (max(1, round(count)) for count in counts)
        speeds = distance * fps / (stop - start), distance * fps / suggested
        intervals.append(KeyInterval(start, stop, suggested, (low, high), distance, *speeds, pose_distance))
    return intervals


def _select_frames(motion: Motion, frames: Sequence[int]) -> Motion:
    """Return a motion of these frames alone."""
    picked = torch.tensor(frames)
    moving = {joint: values[picked] for joint, values in motion.moving_offsets.items()}
    return Motion(motion.skeleton, motion.fps, motion.root_position[picked], motion.local_quat_xyzw[picked], moving)
