"""Losses of the generator of long in-betweens: distances from the truth, keys, the hips' way, style (Zhou et al. 2020,
section 3.6), from which its recipe takes one sum.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool1d
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import kinematics
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.metrics.root_prediction import compute_displacement_errors
from mapctl.numerics.intervals import last_observed, next_observed, true_intervals
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.augmentation.key_layouts import KeySequences
from priors.tweening.generator import GeneratorNetwork, regularise_batch
from priors.tweening.keys import ToldParts, make_key_image
from priors.tweening.path import PathNetwork

_DWELL = 5  # frames for which a pose of the style must be near: none flashes up
_PATH_SPANS = (1, 8, 32, 96)
_SOME = 3  # of so many sequences one has its way predicted and its rotations compared: they cost as much as all else
_ACTIVITY_FRAMES = 32  # over which joints' speeds and accelerations are averaged
_DNA_GAP = 90  # frames, 3 s, for each of which a gap has a pose of the style (Eq. 12)
_METRES = ("places", "pace", "activity", "feet", "keys", "path", "root", "style", "dwell")


@dataclass(frozen=True)
class LossWeights:
    """What each error counts."""

    places: float = 10.0
    """Weight of the distance of joints from where they truly are, seen from the hips, metres."""
    pace: float = 20.0
    """Weight of the error of their steps, metres a frame."""
    activity: float = 20.0
    """Weight of the error of joints' mean speed and acceleration over a second, metres a frame (and frame): who does
    not know the phase of a step steps all the same, and who stands does not tremble."""
    turns: float = 1.0
    """Weight of the error of local rotations: norm of the difference of matrices."""
    keys: float = 10.0
    """Weight of distance and rotations at keys, beside those everywhere."""
    feet: float = 5.0
    """Weight of the planted toes' steps, metres a frame."""
    contacts: float = 0.05
    """Weight of the cross entropy of the contacts that the path predictor sees, nats."""
    path: float = 2.0
    """Weight of the error of the hips' displacements over 1, 8, 32 and 96 frames, metres, where they are known."""
    root: float = 0.3
    """Weight of the distance of the hips' path from its places at keys (Eq. 10), metres."""
    style: float = 4.0
    """Weight of the distance of the style's poses from the nearest that are made (Eq. 11), metres."""
    dwell: float = 2.0
    """Weight of the distance from the style's poses of those that come nearest to one in each gap (Eq. 12), metres."""
    regularisation: float = 0.05
    """Weight of batch regularisation (Eq. 9)."""
    half: float = 60.0
    """Frames from the nearest key at which what a performer did counts half."""


def see_without_root(
    places: Float[Tensor, "*batch joints 3"], hips_world_matrix: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch joints 3"]:
    """Return places from the hips without the hips' rotation."""
    return places @ hips_world_matrix


def compute_tweener_losses(
    network: GeneratorNetwork,
    path: PathNetwork,
    sequences: KeySequences,
    style_poses: Float[Tensor, "batch poses joints 3"],
    styled: Bool[Tensor, " batch"],
    weights: LossWeights,
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors it is made of.

    Where a performer's poses between keys are known they count the less the farther the nearest key is, since more and
    more other motions would do as well.
    """
    motion, known = sequences.motion, sequences.known
    image = make_key_image(motion, sequences.told)
    made_poses = network(image, network.style(style_poses) * styled[:, None])
    made = made_poses.turn_to_world(image)
    wanted = image.places - image.places[..., :1, :]  # seen from the hips, as what is made
    local = motion.local_matrices()
    weight = _weigh_frames(known, weights) * sequences.truthful
    shown = _Errors(made_poses.pose.places, wanted)
    heading = kinematics.heading_of_matrix(made.local_matrix[..., 0, :, :])
    some = slice(0, -(-len(known) // _SOME))
    turned = _length((made.local_matrix[some] - local[some]).flatten(-2)).mean(dim=-1)
    whole = sequences.told.axes[some].flatten(2).all(dim=-1).float()
    terms = {
        "places": shown.places(weight),
        "turns": _average(turned, weight[some]),
        "pace": shown.pace(_between(weight)),
        "activity": shown.activity(sequences.truthful),
        "feet": shown.feet(motion, _between(weight)),
        "keys": shown.keys(sequences.told) + 0.1 * _average(turned, whole),
    }
    trajectory = path(LocalMotion.of_world(made.places[some], heading[some]))
    way = trajectory.integrate(heading[some])
    terms |= _compute_path_terms(trajectory, way, sequences, some, weights)
    without_root = see_without_root(made.places, made.local_matrix[..., 0, :, :])
    apart = torch.cdist(style_poses.flatten(-2), without_root.flatten(-2)) / len(CANONICAL.names) ** 0.5
    terms["style"] = _compute_style_error(apart, styled)
    terms["dwell"] = _compute_dwell_error(apart, known, styled)
    terms["regularisation"] = regularise_batch(tuple(each[some] for each in made_poses.responses))
    loss = torch.stack([getattr(weights, name) * value for name, value in terms.items()]).sum()
    told = {f"{name}_cm": 100 * terms[name] for name in _METRES}
    return {"loss": loss, **told, **{name: terms[name] for name in ("turns", "contacts", "regularisation")}}


class _Errors:
    """Errors of places, seen from the hips along the reference, weighed by frame."""

    def __init__(self, made: Float[Tensor, "batch frames joints 3"], wanted: Float[Tensor, "batch frames joints 3"]):
        self.off = made - wanted
        self.made_steps, self.wanted_steps = torch.diff(made, dim=1), torch.diff(wanted, dim=1)
        self.off_steps = self.made_steps - self.wanted_steps

    def places(self, weight: Tensor) -> Tensor:
        return _average(_length(self.off).mean(dim=-1), weight)

    def pace(self, weight: Tensor) -> Tensor:
        return _average(_length(self.off_steps).mean(dim=-1), weight)

    def activity(self, truthful: Tensor) -> Tensor:
        """Compare speeds and accelerations by joint, whenever within a second they are."""
        if truthful.shape[1] < _ACTIVITY_FRAMES + 2:
            return self.off.new_zeros(())
        error = self.off.new_zeros(())
        for times in (0, 1):
            made, wanted = (_length(torch.diff(each, n=times, dim=1)) for each in (self.made_steps, self.wanted_steps))
            counts = _average_seconds(truthful[:, 1 + times :, None].float())[..., 0] > 0.999
            off = (_average_seconds(made) - _average_seconds(wanted)).abs().mean(dim=-1)
            error = error + _average(off, counts)
        return error

    def keys(self, told: ToldParts) -> Tensor:
        """Compare the coordinates that keys tell of joints but the hips, from which they are seen."""
        joints = told.axes[..., 1:, :].any(dim=-1).float()
        return _average(_length((self.off * told.axes)[..., 1:, :]), joints)

    def feet(self, motion: PartialMotion, weight: Tensor) -> Tensor:
        planted = motion.contacts[:, 1:] * motion.contacts[:, :-1]
        return _average(_length(self.off_steps[..., list(TOE_JOINTS), :]), planted * weight[..., None])


def _compute_path_terms(
    trajectory: RootTrajectory, made: Tensor, sequences: KeySequences, some: slice, weights: LossWeights
) -> dict[str, Tensor]:
    """Errors of where the hips of some sequences go, as the path predictor sees it, metres, and of contacts, nats."""
    motion, known, truthful = sequences.motion, sequences.known[some], sequences.truthful[some]
    hips, contacts = motion.root_position[some], motion.contacts[some]
    steps = truthful.float()
    errors = []
    for span in [span for span in _PATH_SPANS if span < steps.shape[1]]:
        whole = steps.unfold(1, span + 1, 1).amin(dim=-1)
        errors.append(_average(compute_displacement_errors(made[..., ::2], hips[..., ::2], span), whole))
    height = _average((made[..., 1] - hips[..., 1]).abs(), steps)
    placed = sequences.told.placed[some].float()
    share = placed / placed.sum(dim=1, keepdim=True).clamp_min(1)
    off = (made - hips)[..., ::2]
    off = off - (off * share[..., None]).sum(dim=1, keepdim=True)
    nats = cross_entropy(trajectory.contacts, contacts, reduction="none").mean(dim=-1)
    return {
        "path": torch.stack(errors).mean() + height,
        "root": (_length(off) * share).sum(dim=1).mean(),
        "contacts": _average(nats, _weigh_frames(known, weights) * truthful),
    }


def _compute_style_error(apart: Float[Tensor, "batch poses frames"], counts: Bool[Tensor, " batch"]) -> Tensor:
    """How far the style's poses are from the nearest that are made and kept for some frames (Eq. 11), metres."""
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=-1)
    return _average(nearest.mean(dim=-1), counts.float())


def _compute_dwell_error(
    apart: Float[Tensor, "batch poses frames"], known: Bool[Tensor, "batch frames"], counts: Bool[Tensor, " batch"]
) -> Tensor:
    """How far those poses of each gap that come nearest to a pose of the style are from it, one for each 3 s and kept
    for some frames (Eq. 12), metres."""
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=1)
    found = []
    for row in counts.nonzero()[:, 0].tolist():
        for _, start, stop in true_intervals(~known[row][:, None]):
            inside = nearest[row, start : max(start, stop - _DWELL + 1)]
            if poses := (stop - start) // _DNA_GAP:
                # Of each three seconds one: neighbours of the nearest are no pose more.
                found += [part.amin() for part in inside.tensor_split(poses)]
    return torch.stack(found).mean() if found else apart.new_zeros(())


def _weigh_frames(known: Bool[Tensor, "batch frames"], weights: LossWeights) -> Float[Tensor, "batch frames"]:
    """1 at a key, less the farther the nearest is."""
    frame = torch.arange(known.shape[1])
    away = torch.minimum((frame - last_observed(known)).abs(), (next_observed(known) - frame).abs())
    return 1 / (1 + away / weights.half)


def _average_seconds(values: Float[Tensor, "batch frames columns"]) -> Float[Tensor, "batch seconds columns"]:
    """Average over about a second each, without overlap."""
    return avg_pool1d(values.transpose(1, 2), _ACTIVITY_FRAMES).transpose(1, 2)


def _between(weight: Float[Tensor, "batch frames"]) -> Tensor:
    return torch.minimum(weight[:, 1:], weight[:, :-1])


def _average(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1e-6)


def _length(vectors: Tensor) -> Tensor:
    """Length with a gradient at 0."""
    return vectors.square().sum(dim=-1).add(1e-8).sqrt()
