"""Windows of a corpus, as training draws them: of its features, and of joint positions."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.features import LAYOUT, ground_speed, mirror_features
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.partial_motion import interpolate_quats
from mapctl.numerics.intervals import fill_missing, fill_missing_angle
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.corpus import Corpus, find_window_starts, number_clip_folders


def interpolate_positions(
    positions_world: Float[Tensor, "batch frames joints 3"],
    local_quat_xyzw: Float[Tensor, "batch frames joints 4"],
    known: Bool[Tensor, "batch frames joints"],
) -> Float[Tensor, "batch frames joints 3"]:
    """Interpolate world positions, metres, on canonical bones; known ones as they are. Unknown values may be anything
    finite.

    A rotation is known while the joint and its children are.
    """
    shown = known.clone()
    for joint, parent in enumerate(CANONICAL.parents):
        if parent >= 0:
            shown[..., parent] &= known[..., joint]
    matrices = rotations.to_matrix(interpolate_quats(local_quat_xyzw, shown))
    root = fill_missing(positions_world[:, :, 0], known[..., 0])
    interpolated = kinematics.positions_from_matrices(CANONICAL, matrices) + root[:, :, None]
    return torch.where(known[..., None], positions_world, interpolated)


def interpolate_heading(heading: Float[Tensor, "batch frames"], known: Bool[Tensor, "batch frames joints"]) -> Tensor:
    """Interpolate headings, radians, linearly along the shorter arc between frames whose root is known."""
    return fill_missing_angle(heading, known[..., 0])


_CHUNK_FRAMES = 50_000  # frames
_GOING = 0.25  # m/s that the hips of somebody who goes reach, on average over the frames around one
_AROUND = 9  # frames, so that who shifts his weight goes nowhere


@dataclass(frozen=True, eq=False)
class FeatureBatch:
    """Windows of features."""

    features: Float[Tensor, "batch window size"]
    """As in the corpus, or mirrored."""
    first: Int[Tensor, " batch"]
    """Frame of the joined corpus that each begins with."""
    mirrored: Bool[Tensor, " batch"]
    """Whether left and right are exchanged."""


class FeatureWindows:
    """Draws windows from a corpus."""

    def __init__(self, corpus: Corpus, frames: int, *, evenness: float | None = None, standing_share: float = 1.0):
        """`evenness` among the corpus' top folders: 0 draws by their frames, 1 the same number from each; None draws
        by frames without a look at folders. Of the windows in which the hips stay under 0.25 m/s only
        `standing_share` is drawn. RequestError where no clip is as long as a window.
        """
        self.features, self.frames = corpus.features, frames
        self.starts = find_window_starts(corpus.lengths, frames)
        if standing_share < 1:
            self.starts = _thin_standing(self.features, self.starts, frames, standing_share)
        if evenness is not None:
            folder = number_clip_folders(corpus).repeat_interleave(torch.tensor(corpus.lengths))
            # Grouped, so that drawing a folder and then a window in it needs no table of all windows' chances.
            self.groups = [self.starts[folder[self.starts] == number] for number in folder.unique()]
            self.groups = [group for group in self.groups if len(group)]
            self.probabilities = torch.tensor([float(len(group)) for group in self.groups]) ** (1 - evenness)
        self._pick = self._pick_any if evenness is None else self._pick_evened

    def draw(self, batch: int, generator: torch.Generator, *, mirror: bool = True) -> FeatureBatch:
        """So many, half of them mirrored if that is allowed."""
        first = self._pick(batch, generator)
        windows = self.features[first[:, None] + torch.arange(self.frames)]
        if not mirror:
            return FeatureBatch(windows, first, torch.zeros(batch, dtype=torch.bool))
        mirrored = torch.rand(batch, generator=generator) < 0.5
        windows = torch.where(mirrored[:, None, None], mirror_features(windows), windows)
        return FeatureBatch(windows, first, mirrored)

    def _pick_any(self, batch: int, generator: torch.Generator) -> Int[Tensor, " batch"]:
        return self.starts[torch.randint(len(self.starts), (batch,), generator=generator)]

    def _pick_evened(self, batch: int, generator: torch.Generator) -> Int[Tensor, " batch"]:
        groups = torch.multinomial(self.probabilities, batch, replacement=True, generator=generator)
        shares = torch.rand(batch, generator=generator)
        return torch.stack(
            [
                self.groups[group][int(share * len(self.groups[group]))]
                for group, share in zip(groups.tolist(), shares.tolist(), strict=True)
            ]
        )


def _thin_standing(
    features: Float[Tensor, "frames size"], starts: Int[Tensor, " starts"], frames: int, share: float
) -> Int[Tensor, " left"]:
    """Leave this share of the windows in which nobody goes anywhere, evenly over the corpus, and all others."""
    around = torch.full((1, 1, _AROUND), 1 / _AROUND)
    padded = torch.nn.functional.pad(ground_speed(features)[None, None], (_AROUND // 2, _AROUND // 2), mode="replicate")
    speed = torch.nn.functional.conv1d(padded, around)[0, 0]
    standing = speed.unfold(0, frames, 1).amax(-1)[starts] < _GOING
    number = standing.cumsum(0)
    left = (share * number).ceil() > (share * (number - 1)).ceil()
    return starts[~standing | left]


@dataclass(frozen=True, eq=False)
class Window:
    """A batch of whole motions."""

    places: Float[Tensor, "batch frames joints 3"]
    """World, metres, on canonical bones."""
    quats: Float[Tensor, "batch frames joints 4"]
    """Local rotations, xyzw."""
    heading: Float[Tensor, "batch frames"]
    """Heading of the hips, radians."""
    contacts: Float[Tensor, "batch frames 2"]
    """Left and right toe planted, 0 or 1."""
    present: Bool[Tensor, "batch frames"]
    """Whether there is such a frame; the clip may be shorter."""

    def image(self, known: Bool[Tensor, "batch frames joints"]) -> PositionImage:
        """With gaps, in which the guess is slerp's."""
        known = known & self.present[..., None]
        places = interpolate_positions(self.places, self.quats, known)
        return PositionImage.of_world(
            places,
            interpolate_heading(self.heading, known),
            self.contacts,
            known=known,
            present=self.present,
            toes=TOE_JOINTS,
        )


class PositionWindows:
    """Draws windows from a corpus, half of them mirrored."""

    def __init__(self, corpus: Corpus, *, frames: int, evenness: float):
        """`evenness` among the corpus' top folders: 0 draws by their frames, 1 the same number from each."""
        self.frames = frames
        self.lengths, self.clip_starts = corpus.locate_clips()
        self.ground, self.heading = corpus.integrate_roots()
        self.contacts = LAYOUT.pick(corpus.features, "contacts")
        poses = [BodyPose.of_features_in_place(part) for part in corpus.features.split(_CHUNK_FRAMES)]
        self.local = torch.cat([pose.joints_world() for pose in poses])
        self.quats = torch.cat([pose.local_quat_xyzw for pose in poses])
        folder = number_clip_folders(corpus)
        share = torch.zeros(int(folder.max()) + 1).index_add(0, folder, self.lengths.float())
        self.probabilities = self.lengths / share[folder] ** evenness
        self.mirror_joints = CANONICAL.mirror_partners()

    def moments(self) -> tuple[Float[Tensor, "joints 3"], Float[Tensor, "joints 3"]]:
        """Mean and standard deviation of each position relative to its own root, of a motion and its mirror image."""
        flip = self.local.new_tensor([-1.0, 1.0, 1.0])
        mean, square = self.local.mean(dim=0), self.local.square().mean(dim=0)
        mean, square = (mean + flip * mean[self.mirror_joints]) / 2, (square + square[self.mirror_joints]) / 2
        return mean, (square - mean.square()).clamp_min(0).sqrt()

    def draw(self, batch: int, generator: torch.Generator) -> Window:
        """So many windows, clips by chance and moments evenly."""
        clip = torch.multinomial(self.probabilities, batch, replacement=True, generator=generator)
        spare = self.lengths[clip] - self.frames  # a shorter clip begins anywhere in the window
        lead = (torch.rand(batch, generator=generator) * (spare.abs() + 1)).long() * torch.sign(spare)
        return self.at(clip, lead, mirrored=torch.rand(batch, generator=generator) < 0.5)

    def at(
        self, clip: Int[Tensor, " batch"], first: Int[Tensor, " batch"], *, mirrored: Bool[Tensor, " batch"]
    ) -> Window:
        """From these frames of these clips on; frames before a clip's first and after its last are not present."""
        frame = first[:, None] + torch.arange(self.frames)
        present = (frame >= 0) & (frame < self.lengths[clip][:, None])
        index = self.clip_starts[clip][:, None] + frame.clamp_min(0).minimum(self.lengths[clip][:, None] - 1)
        local, heading, contacts = self.local[index], self.heading[index], self.contacts[index]
        ground, side = self.ground[index], torch.where(mirrored, -1.0, 1.0)[:, None]
        flip = torch.stack([side, torch.ones_like(side), torch.ones_like(side)], dim=-1)
        local = torch.where(mirrored[:, None, None, None], local[:, :, self.mirror_joints], local) * flip[:, :, None]
        contacts = torch.where(mirrored[:, None, None], contacts.flip(-1), contacts)
        heading, ground = heading * side, ground * flip[..., ::2]
        places = rotations.rotate_about_y(local, heading[..., None]) + rotations.lift_ground(ground)[:, :, None]
        quats = self.quats[index]
        over = quats[:, :, self.mirror_joints] * quats.new_tensor([1.0, -1.0, -1.0, 1.0])
        quats = torch.where(mirrored[:, None, None, None], over, quats)
        quats[:, :, 0] = rotations.multiply(rotations.about_y(heading), quats[:, :, 0])
        return Window(places, quats, heading, contacts, present)
