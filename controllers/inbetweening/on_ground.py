"""Keys that stand on ground that is not flat.

They are brought to a flat floor, the motion between them is found there as ever, and put onto the ground; what it then
misses its keys by is removed by the smoothest offsets of hips, joints and feet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controllers.shots.uneven import Footing, Sole, SteppedMotion, find_slope, fit_planes, step_onto_ground
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.ground import Ground
from mapctl.intent.keyframes import Key
from mapctl.motion import Motion
from mapctl.numerics.smooth_offsets import interpolate_offsets, interpolate_turns
from mapctl.recording.fusion import transfer_change
from mapctl.retarget import RigMap, as_rig, from_canonical, to_canonical
from mapctl.retarget.character import TOES, Stance, rotate_foot_frames
from mapctl.retarget.legs import bend_legs, find_ankles, locate_feet, lower_by

_FADE_SECONDS = 0.3  # over which a correction at a key fades


@dataclass(frozen=True, eq=False)
class KeysOnGround:
    """Whole poses that stand on ground, in frames of a motion on its rig."""

    motion: Motion
    frames: Int[Tensor, " keys"]
    rigmap: RigMap
    stance: Stance
    level: Motion
    """The motion on canonical joints whose feet are level."""
    ground: Ground

    @staticmethod
    def of(motion: Motion, canonical: Motion, keys: Sequence[Key], rigmap: RigMap, ground: Ground) -> "KeysOnGround":
        """Collect the keys of a motion that is canonical as well; RequestError where one is no whole pose."""
        if any(key.what != "pose" for key in keys):
            raise RequestError("on ground that is not flat keys are whole poses; leave out the ground, or other keys")
        lowest = ground.height(canonical.joint_positions()[:, TOES, ::2]).amin(dim=1)
        stance = Stance.of(lower_by(canonical, lowest), rigmap)
        level = rotate_foot_frames(canonical, -stance.tilt)
        return KeysOnGround(motion, torch.tensor([key.frame for key in keys]), rigmap, stance, level, ground)

    def on_floor(self) -> Motion:
        """Return the motion with its keys on a flat floor."""
        lowered = _bring_to_floor(self.level.pick(self.frames), self.ground, self.stance)
        lowered = rotate_foot_frames(lowered, self.stance.tilt)
        return self._with_keys(self.motion, from_canonical(lowered, self.rigmap, self.motion.pick(self.frames)))

    def put_between(self, motion: Motion) -> tuple[Motion, Footing]:
        """Put a motion through the keys on a flat floor, of the same rig, onto the ground and through the keys there;
        also return how its feet stand."""
        level = rotate_foot_frames(to_canonical(motion, as_rig(self.rigmap))[0], -self.stance.tilt)
        flat, height = level.resample(PRIOR_FPS), float(self.stance.standing_height.mean())
        at_keys = (self.frames * PRIOR_FPS / float(motion.fps)).round().long().tolist()
        stepped = step_onto_ground(flat, self.ground, height, keys=at_keys)
        seconds = torch.arange(flat.num_frames, dtype=torch.float64) / PRIOR_FPS
        met = meet_keys(stepped, transfer_change(level, flat, stepped.motion, seconds), self.level, self.frames)
        sampled = replace(stepped, motion=met.resample(PRIOR_FPS))
        lifted = sampled.lift_swings(at_keys)
        met = transfer_change(met, sampled.motion, lifted.motion, seconds)
        found = from_canonical(rotate_foot_frames(met, self.stance.tilt), self.rigmap, motion)
        return self._with_keys(found, self.motion.pick(self.frames)), lifted.measure_footing()

    def _with_keys(self, motion: Motion, poses: Motion) -> Motion:
        """Return a motion with poses in the frames of keys, to the bit but for the signs of quaternions."""
        root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
        root[self.frames], quats[self.frames] = poses.root_position, poses.local_quat_xyzw
        return replace(motion, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))


def _bring_to_floor(poses: Motion, ground: Ground, stance: Stance) -> Motion:
    """Bring canonical poses on a ground onto the flat floor: feet as high over it and as level as over what they stand
    on, hips lower by the mean of both."""
    (toes, feet), lower = locate_feet(poses), torch.zeros(poses.num_frames, 2, dtype=torch.float64)
    for foot in range(2):
        sole = Sole.of(poses, float(stance.standing_height[foot]), foot)
        for frame, facing in enumerate(rotations.split_heading(feet[:, foot])[0]):
            heights, gradients, _, _ = fit_planes(toes[frame, foot, ::2][None], facing, ground, sole)
            lower[frame, foot] = heights[0]
            slope = rotations.inverse(find_slope(gradients[0]))
            feet[frame, foot] = rotations.multiply(slope, feet[frame, foot])
    toes[..., 1] -= lower
    return bend_legs(lower_by(poses, lower.mean(dim=1)), find_ankles(poses.skeleton, toes, feet), feet)


def meet_keys(stepped: SteppedMotion, motion: Motion, keyed: Motion, keys: Int[Tensor, " keys"]) -> Motion:
    """Bring a canonical motion, as it was put onto ground, to the poses of another in the frames of keys. A foot that
    stands at a key is moved as much for as long as it stands, one that stands between keys stays."""
    at_keys, fps = torch.zeros(motion.num_frames, dtype=torch.bool), float(motion.fps)
    at_keys[keys] = True

    def move(off: Float[Tensor, "frames 3"], firm: Bool[Tensor, " frames"] = at_keys) -> Float[Tensor, "frames 3"]:
        return interpolate_offsets(off, firm, seconds=_FADE_SECONDS, fps=fps)

    def turn(found: Float[Tensor, "frames n 4"], wanted: Float[Tensor, "frames n 4"]) -> Float[Tensor, "frames n 4"]:
        firm = at_keys[:, None].expand(found.shape[:2])
        return interpolate_turns(found, wanted, firm, seconds=_FADE_SECONDS, fps=fps)

    (toes, feet), (wanted, wanted_feet) = locate_feet(motion), locate_feet(keyed)
    off, firm = (wanted - toes) * at_keys[:, None, None], at_keys[:, None].repeat(1, 2)
    for hold in stepped.holds:
        start, stop = (round(frame * fps / PRIOR_FPS) for frame in (hold.start, hold.stop))
        firm[start:stop, hold.foot] = True
        if len(inside := keys[(keys >= start) & (keys < stop)]):
            held = [np.interp(np.arange(start, stop), inside, axis) for axis in off[inside, hold.foot].T]
            off[start:stop, hold.foot] = torch.from_numpy(np.stack(held, axis=1))
    toes += torch.stack([move(off[:, foot], firm[:, foot]) for foot in range(2)], dim=1)
    root = motion.root_position + move(keyed.root_position - motion.root_position)
    bent = replace(motion, root_position=root, local_quat_xyzw=turn(motion.local_quat_xyzw, keyed.local_quat_xyzw))
    feet = turn(feet, wanted_feet)
    return bend_legs(bent, find_ankles(motion.skeleton, toes, feet), feet)
