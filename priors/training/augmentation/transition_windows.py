"""Windows of a corpus as transitions between two poses: what is known of each end, and what truly comes between."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.contacts.phases import compute_phases, mirror_phases, reversed_phases
from mapctl.features import LAYOUT, GroundPose, integrate_root, mirror_features, reversed_features
from mapctl.kinematics.joint_places import place_joints
from mapctl.skeleton import CANONICAL
from priors.stitching.sides import Ends
from priors.training.augmentation.pose_windows import WindowPicker
from priors.training.corpus import Corpus


class Known(NamedTuple):
    """What is told of the ends of a transition."""

    before: int = 0
    """Frames before the first pose."""
    after: int = 0
    """Frames after the second."""


@dataclass(frozen=True, eq=False)
class Transition:
    """Transitions of one length, with a frame or more on either side."""

    features: Float[Tensor, "batch window size"]
    """Forwards, from the first frame told before to the last one told after."""
    phases: Float[Tensor, "batch window 4"]
    """Of both toes."""
    frames: int
    """From one pose to the other."""
    lead: int
    """Frames of the window before the first pose."""
    known: Known
    """What is told."""

    @property
    def between(self) -> slice:
        """Frames after the first pose, up to and with the second."""
        return slice(self.lead + 1, self.lead + self.frames + 1)

    def rows(self, index: Tensor) -> "Transition":
        """Return some of the transitions."""
        return replace(self, features=self.features[index], phases=self.phases[index])

    def ends(self) -> Ends:
        """What a stitcher is given."""
        known, back = self.known, reversed_features(self.features)
        context = 1 + max(known.before, known.after)
        last = self.features.shape[1] - 1 - self.lead - self.frames  # the second pose, counted backwards
        sides, present = [], []
        for features, at, count in ((self.features, self.lead, known.before), (back, last, known.after)):
            rows = features[:, at - count : at + 1]
            sides.append(torch.cat([rows[:, :1].expand(-1, context - 1 - count, -1), rows], dim=1))
            present.append((torch.arange(context) >= context - 1 - count).float())
        place, turn = self.integrate()
        batch = len(self.features)
        return Ends(torch.stack(sides), torch.stack(present)[:, None].expand(-1, batch, -1), place[:, -1], turn[:, -1])

    def integrate(self) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
        """Places over the ground and headings of the frames between and of the second pose, seen from the first."""
        return integrate_root(self.features[:, self.between], GroundPose.origin())

    def truth(self) -> Float[Tensor, "2 batch frames size"]:
        """Features from each end's next frame to the other end, in the sides' senses of time."""
        first = self.features.shape[1] - self.lead - self.frames
        back = reversed_features(self.features)[:, first : first + self.frames]
        return torch.stack([self.features[:, self.between], back])

    def place_joints(self, made: int) -> Float[Tensor, "2 batch made joints 3"]:
        """Place the joints of the frames that each side is to make first, metres, seen from the first pose."""
        ground, heading = self.integrate()
        places = place_joints(self.features[:, self.between], ground, heading, CANONICAL)
        return torch.stack([places[:, :made], places[:, :-1].flip(1)[:, :made]])

    def true_phases(self) -> Float[Tensor, "2 batch frames 4"]:
        """Phases of each end and of all frames up to the last before the other end, in the sides' senses of time."""
        first = self.features.shape[1] - self.lead - self.frames
        there = self.phases[:, self.lead : self.lead + self.frames]
        return torch.stack([there, reversed_phases(self.phases)[:, first - 1 : first - 1 + self.frames]])


class TransitionWindows:
    """Draws transitions from a corpus, half of them mirrored."""

    def __init__(self, corpus: Corpus, *, kinds: Sequence[str], evenness: float):
        """`evenness` among kinds of clips, as `WindowPicker` takes it."""
        self.features = corpus.features
        self.phases = torch.cat([compute_phases(LAYOUT.pick(clip, "contacts")) for clip in corpus.clips()]).to(
            self.features
        )
        self.picker = WindowPicker(corpus, kinds=kinds, evenness=evenness)
        self.starts = corpus.locate_clips()[1]

    def draw(self, batch: int, frames: int, known: Known, generator: torch.Generator) -> Transition:
        """So many transitions of so many frames; RequestError where no clip is so long."""
        lead, rest = max(known.before, 1), max(known.after, 1)  # one frame more tells the pace of the ends
        window = lead + frames + 1 + rest
        clip, first = self.picker.pick(torch.full((batch,), window), generator)
        index = (self.starts[clip] + first)[:, None] + torch.arange(window)
        mirrored = (torch.rand(batch, generator=generator) < 0.5)[:, None, None]
        features, phases = self.features[index], self.phases[index]
        features = torch.where(mirrored, mirror_features(features), features)
        return Transition(features, torch.where(mirrored, mirror_phases(phases), phases), frames, lead, known)
