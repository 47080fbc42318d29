"""Animations of a glTF document, read at the frames of one rate."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import FileFormatError
from mapctl.formats.characters.key_times import sample_times
from mapctl.formats.characters.names import make_unique
from mapctl.formats.characters.rest_frames import compose_matrices
from mapctl.formats.gltf.accessors import read_accessor
from mapctl.formats.gltf.armatures import node_matrix
from mapctl.formats.gltf.container import GltfFile
from mapctl.formats.gltf.schema import Node, Sampler
from mapctl.formats.text import check_extent

Array = np.ndarray
_WIDTHS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}


@dataclass(frozen=True, eq=False)
class Track:
    """Keys of one property of a node."""

    node: int
    path: str
    """translation, rotation or scale."""
    times: Array
    """(keys,) seconds, increasing."""
    values: Array
    """(keys, 3 or 4), or (3 keys, 3 or 4) with tangents for cubic splines."""
    interpolation: str


def name_animations(gltf: GltfFile) -> list[str]:
    """Return the names of a file's animations, unique, in its order."""
    return make_unique([a.name or f"animation_{k}" for k, a in enumerate(gltf.document.animations)])


def time_animations(gltf: GltfFile, nodes: Sequence[int]) -> dict[str, float]:
    """Return the seconds that each animation lasts that moves these nodes, by name, without those whose key times
    cannot be read."""
    found = {}
    for name, animation in zip(name_animations(gltf), gltf.document.animations, strict=True):
        own = [c.sampler for c in animation.channels if c.target.node in nodes and c.target.path in _WIDTHS]
        with suppress(FileFormatError, IndexError):
            inputs = {animation.samplers[sampler].input for sampler in own}
            ends = [read_accessor(gltf, times, "SCALAR")[[0, -1], 0].tolist() for times in inputs]
            if ends:
                found[name] = max(end for _, end in ends) - min(start for start, _ in ends)
    return found


def read_tracks(gltf: GltfFile, animation: int, nodes: Sequence[int]) -> list[Track]:
    """Read the tracks of these nodes in an animation; empty where it moves none of them."""
    found, wanted = [], set(nodes)
    channels = gltf.document.animations[animation].channels
    samplers = gltf.document.animations[animation].samplers
    for number, channel in enumerate(channels):
        node, path = channel.target.node, channel.target.path
        if node not in wanted or path not in _WIDTHS:
            continue
        if channel.sampler >= len(samplers):
            what = f"animations[{animation}].channels[{number}] names sampler {channel.sampler}"
            raise FileFormatError(gltf.path, f"{what}, there are {len(samplers)}")
        what = f"animations[{animation}].samplers[{channel.sampler}]"
        found.append(_read_track(gltf, node, path, samplers[channel.sampler], what))
    return found


def sample_local_matrices(gltf: GltfFile, nodes: Sequence[int], tracks: Sequence[Track]) -> tuple[Fraction, Array]:
    """Return frames per second, and local matrices (frames, nodes, 4, 4) at its frames, from the first key to the last.

    FileFormatError where there would be too many.
    """
    keys = np.concatenate([track.times for track in tracks])
    span = float(keys.max() - keys.min())
    check_extent(gltf.path, int(span), 1)
    fps, times = sample_times(keys)
    check_extent(gltf.path, len(times), len(nodes))
    by_node: dict[int, list[Track]] = {}
    for track in tracks:
        by_node.setdefault(track.node, []).append(track)
    matrices = np.empty((len(times), len(nodes), 4, 4))
    for place, node in enumerate(nodes):
        own = gltf.document.nodes[node]
        matrices[:, place] = _sample_node(own, by_node[node], times) if node in by_node else node_matrix(own)
    return fps, matrices


def _read_track(gltf: GltfFile, node: int, path: str, sampler: Sampler, what: str) -> Track:
    times = read_accessor(gltf, sampler.input, "SCALAR")[:, 0].astype(np.float64)
    values = read_accessor(gltf, sampler.output, _WIDTHS[path]).astype(np.float64)
    keys = len(times) * (3 if sampler.interpolation == "CUBICSPLINE" else 1)
    if len(values) != keys:
        raise FileFormatError(gltf.path, f"{what} has {len(times)} key times and {len(values)} values, expected {keys}")
    if (np.diff(times) < 0).any() or times[0] < 0 or times[-1] > 1e6:
        raise FileFormatError(gltf.path, f"{what}: key times must increase, from 0 to a million seconds")
    if path == "rotation" and sampler.interpolation != "CUBICSPLINE":
        lengths = np.linalg.norm(values, axis=1)
        if (abs(lengths - 1) > 0.1).any():
            raise FileFormatError(gltf.path, f"{what}: a rotation is no unit quaternion")
        values = values / lengths[:, None]
    return Track(node, path, times, values, sampler.interpolation)


def _sample_node(node: Node, tracks: Sequence[Track], times: Array) -> Array:
    count = len(times)
    parts = {
        "translation": np.tile(np.array(node.translation), (count, 1)),
        "rotation": np.tile(np.array(node.rotation), (count, 1)),
        "scale": np.tile(np.array(node.scale), (count, 1)),
    }
    for track in tracks:
        parts[track.path] = sample_track(track, times)
    lengths = np.linalg.norm(parts["rotation"], axis=1, keepdims=True)
    turns = np.where(lengths > 1e-9, parts["rotation"] / np.maximum(lengths, 1e-9), np.array([0.0, 0.0, 0.0, 1.0]))
    return compose_matrices(parts["translation"], turns, parts["scale"])


def sample_track(track: Track, times: Array) -> Array:
    """Return a track's values (times, 3 or 4) at times, seconds; before its first and after its last key it holds."""
    keys = track.times
    if len(keys) == 1:
        return np.tile(track.values[1 if track.interpolation == "CUBICSPLINE" else 0], (len(times), 1))
    low = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
    gap = np.maximum(keys[low + 1] - keys[low], 1e-12)
    share = np.clip((times - keys[low]) / gap, 0.0, 1.0)
    if track.interpolation == "CUBICSPLINE":
        return _sample_spline(track.values.reshape(len(keys), 3, -1), low, gap, share)
    before, after = track.values[low], track.values[low + 1]
    if track.interpolation == "STEP":
        return np.where((share >= 1.0)[:, None], after, before)
    if track.path == "rotation":
        turns = rotations.slerp(*(torch.from_numpy(values) for values in (before, after, share)))
        return turns.numpy()
    return before + (after - before) * share[:, None]


def _sample_spline(keys: Array, low: Array, gap: Array, share: Array) -> Array:
    """Read cubic Hermite splines; `keys` (keys, 3, width) are in-tangent, value and out-tangent."""
    t, gap = share[:, None], gap[:, None]
    before, after = keys[low, 1], keys[low + 1, 1]
    leave, arrive = keys[low, 2] * gap, keys[low + 1, 0] * gap
    rise, bend = t * t * (3 - 2 * t), t * (1 - t)
    return before + (after - before) * rise + bend * ((1 - t) * leave - t * arrive)
