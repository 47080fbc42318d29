"""The pose in which a skin is bound, completed for joints that carry nothing."""

from collections.abc import Mapping

import numpy as np

from mapctl.formats.characters.rest_frames import UnevenScaleError, split_scales

Array = np.ndarray
_BONE_SHARE = 0.02  # of a bone's length by which it may differ between bind pose and nodes


def complete_bind_pose(parents: tuple[int, ...], bound: Mapping[int, Array], worlds: Array) -> Array | None:
    """Complete the world matrices (4, 4) of a bind pose, by joint, with those of the nodes, (joints, 4, 4), for joints
    that it leaves out; None unless all bones are as long as the nodes', and joints are scaled like them."""
    done = np.empty_like(worlds)
    for joint, parent in enumerate(parents):
        above = np.eye(4) if parent < 0 else done[parent]
        own = worlds[joint] if parent < 0 else np.linalg.pinv(worlds[parent]) @ worlds[joint]
        done[joint] = bound.get(joint, above @ own)
        if parent >= 0:
            length, usual = (np.linalg.norm(w[joint][:3, 3] - w[parent][:3, 3]) for w in (done, worlds))
            if abs(length - usual) > _BONE_SHARE * max(usual, 0.02):
                return None
    try:
        scales = split_scales(parents, done)[1] / split_scales(parents, worlds)[1]
    except UnevenScaleError:
        return None
    return done if np.allclose(scales, 1.0, rtol=1e-2) else None
