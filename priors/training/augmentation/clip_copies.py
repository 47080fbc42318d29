"""Copies of clips at other tempos and with other strides, for corpora of a few minutes.

Features hold rotations and the way of the hips, and priors are decoded on canonical bones: a body's proportions show in
them as how far and how high it steps alone. So a body with other legs is a motion whose feet go further or less far
over the same floor, and whose legs reach them; arms and trunk of other lengths would change nothing.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, encode
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.motion import Motion
from mapctl.pose import BodyPose
from mapctl.retarget.carry import fit_hips, lower_hips, reach_ankle_targets
from mapctl.retarget.character import FEET, LEGS, TOES, limb_extension
from mapctl.rotations import to_rotation_vector
from priors.training.augmentation.pose_windows import PoseWindows
from priors.training.corpus import Corpus

_MOST = 0.3  # change of tempo or stride, beyond which walks are no longer likely


@dataclass(frozen=True)
class ClipCopies:
    """How many copies of each clip are trained on beside it, and how they vary."""

    count: int = 0
    """Copies of each clip."""
    tempo: float = 0.15
    """Largest change of tempo, as a share: 0.15 plays at 0.85 to 1.15 of the speed."""
    strides: float = 0.1
    """Largest change of how far feet and hips go, as a share: as of a body with longer or shorter legs."""

    def __post_init__(self):
        if self.count < 0:
            raise RequestError(f"--copies must be 0 or more, got {self.count}")
        for name in ("tempo", "strides"):
            if not 0 <= getattr(self, name) <= _MOST:
                raise RequestError(f"--{name} must lie between 0 and {_MOST}, got {getattr(self, name):g}")


def add_copies(corpus: Corpus, copies: ClipCopies, generator: torch.Generator) -> Corpus:
    """Return a corpus with its clips, and after them so many copies of each, under the same names."""
    if copies.count == 0:
        return corpus
    windows = PoseWindows(corpus, kinds=(), evenness=0.0)
    names, clips = list(corpus.names), corpus.clips()
    for _ in range(copies.count):
        for number, name in enumerate(corpus.names):
            change = 2 * torch.rand(2, generator=generator) - 1
            tempo, strides = 1 + copies.tempo * float(change[0]), 1 + copies.strides * float(change[1])
            if corpus.lengths[number] > 1 + tempo:
                clips.append(copy_clip(windows, number, tempo=tempo, strides=strides))
                names.append(name)
    return Corpus(tuple(names), tuple(map(len, clips)), torch.cat(clips), corpus.skipped, corpus.cuts)


def copy_clip(windows: PoseWindows, number: int, *, tempo: float, strides: float) -> Float[Tensor, "frames size"]:
    """Features of a corpus' clip at another tempo, with other strides: both are factors.

    Frames are interpolated where they lie between two; a toe is planted where it is in both.
    """
    clip = torch.tensor([number])
    frames = int((int(windows.lengths[number]) - 1) / tempo) + 1
    played = windows.at(clip, torch.zeros_like(clip), frames, torch.tensor([tempo]))
    features = encode(change_strides(_as_motion(played), strides))[0].float()
    time = tempo * torch.arange(frames)
    bits = windows.contacts.split(windows.lengths.tolist())[number]
    features[:, LAYOUT.slices["contacts"]] = bits[time.floor().long()] * bits[time.ceil().long()]
    return features


def change_strides(motion: Motion, factor: float) -> Motion:
    """Return a motion on canonical joints whose hips and feet go this many times as far over the ground.

    Toes keep their heights, feet their orientation, and what stands stands: all places are scaled from one point of
    the floor, which also sets feet further apart. Legs reach there, and the hips go down where they would be too short.
    """
    if factor == 1:
        return motion  # legs as straight as can be would bend a little
    places, scale = motion.joint_positions(), motion.root_position.new_tensor([factor, 1.0, factor])
    # From the toe joints on, which stand while the heel rises.
    ankles = scale * places[:, TOES] + places[:, FEET] - places[:, TOES]
    stretch = limb_extension(motion, LEGS)
    moved = replace(motion, root_position=scale * motion.root_position)
    moved = lower_hips(fit_hips(moved, ankles, stretch), ankles, stretch)
    return reach_ankle_targets(moved, ankles)


def _as_motion(played: PartialMotion) -> Motion:
    """The first of a batch of motions of which everything is known."""
    vectors = to_rotation_vector(played.quats[0].double())
    pose = BodyPose(played.root_position[0].double(), played.heading[0].double(), vectors[:, 0, ::2], vectors[:, 1:])
    return pose.motion()
