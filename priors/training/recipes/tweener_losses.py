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
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.augmentation.key_layouts import KeySequences
from priors.tweening.generator import GeneratorNetwork, regularise_batch
from priors.tweening.keys import make_key_image
from priors.tweening.path import PathNetwork
from priors.tweening.range_constrained import ConstrainedPose

_HALF_WEIGHT_FRAMES = 60.0  # away from the nearest key
_DWELL = 5  # frames for which a pose of the style must be near: none flashes up
_PATH_SPANS = (1, 8, 32)
_METRES = ("places", "pace", "feet", "keys", "path", "root", "style")


@dataclass(frozen=True)
class LossWeights:
    """What each error counts."""

    places: float = 10.0
    """Weight of the distance of joints from where they truly are, seen from the hips, metres."""
    pace: float = 20.0
    """Weight of the error of their steps, metres a frame."""
    turns: float = 1.0
    """Weight of the error of local rotations: norm of the difference of matrices."""
    keys: float = 10.0
    """Weight of distance and rotations at keys, beside those everywhere."""
    feet: float = 5.0
    """Weight of the planted toes' steps, metres a frame."""
    contacts: float = 0.05
    """Weight of the cross entropy of the contacts that the path predictor sees, nats."""
    path: float = 2.0
    """Weight of the error of the hips' displacements over 1, 8 and 32 frames, metres, where they are known."""
    root: float = 0.3
    """Weight of the distance of the hips' path from its places at keys (Eq. 10), metres."""
    style: float = 2.0
    """Weight of the distance of the style's poses from the nearest that are made (Eq. 11), metres."""
    regularisation: float = 0.05
    """Weight of batch regularisation (Eq. 9)."""


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
    image = make_key_image(motion, known)
    made_poses = network(image, network.style(style_poses) * styled[:, None])
    made = made_poses.turn_to_world(image)
    local = motion.local_matrices()
    wanted = kinematics.positions_from_matrices(CANONICAL, local)
    weight = _weigh_frames(known) * sequences.truthful
    shown = _Errors(made, wanted, local)
    terms = {
        "places": shown.places(weight),
        "turns": shown.turns(weight),
        "pace": shown.pace(_between(weight)),
        "feet": shown.feet(motion, _between(weight)),
        "keys": shown.places(known.float()) + 0.1 * shown.turns(known.float()),
    }
    heading = kinematics.heading_of_matrix(made.local_matrix[..., 0, :, :])
    trajectory = path(LocalMotion.of_world(made.places, heading))
    terms |= _compute_path_terms(trajectory, heading, sequences)
    without_root = see_without_root(made.places, made.local_matrix[..., 0, :, :])
    terms["style"] = _compute_style_error(without_root, style_poses, styled & ~sequences.truthful.all(dim=1))
    terms["regularisation"] = regularise_batch(made_poses.responses)
    loss = torch.stack([getattr(weights, name) * value for name, value in terms.items()]).sum()
    told = {f"{name}_cm": 100 * terms[name] for name in _METRES}
    return {"loss": loss, **told, **{name: terms[name] for name in ("turns", "contacts", "regularisation")}}


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors of poses, weighed by frame."""

    made: ConstrainedPose
    wanted: Float[Tensor, "batch frames joints 3"]
    local: Float[Tensor, "batch frames joints 3 3"]

    def places(self, weight: Tensor) -> Tensor:
        return _average(_length(self.made.places - self.wanted).mean(dim=-1), weight)

    def turns(self, weight: Tensor) -> Tensor:
        return _average(_length((self.made.local_matrix - self.local).flatten(-2)).mean(dim=-1), weight)

    def pace(self, weight: Tensor) -> Tensor:
        return _average(_length(torch.diff(self.made.places - self.wanted, dim=1)).mean(dim=-1), weight)

    def feet(self, motion: PartialMotion, weight: Tensor) -> Tensor:
        slip = torch.diff((self.made.places - self.wanted)[..., list(TOE_JOINTS), :], dim=1)
        planted = motion.contacts[:, 1:] * motion.contacts[:, :-1]
        return _average(_length(slip), planted * weight[..., None])


def _compute_path_terms(trajectory: RootTrajectory, heading: Tensor, sequences: KeySequences) -> dict[str, Tensor]:
    """Errors of where the hips go, as the path predictor sees it, metres, and of contacts, nats."""
    hips, truthful = sequences.motion.root_position, sequences.truthful
    made = trajectory.integrate(heading)
    steps = truthful.float()
    errors = []
    for span in [span for span in _PATH_SPANS if span < steps.shape[1]]:
        whole = steps.unfold(1, span + 1, 1).amin(dim=-1)
        errors.append(_average(compute_displacement_errors(made[..., ::2], hips[..., ::2], span), whole))
    height = _average((made[..., 1] - hips[..., 1]).abs(), steps)
    share = sequences.known.float() / sequences.known.sum(dim=1, keepdim=True).clamp_min(1)
    off = (made - hips)[..., ::2]
    off = off - (off * share[..., None]).sum(dim=1, keepdim=True)
    nats = cross_entropy(trajectory.contacts, sequences.motion.contacts, reduction="none").mean(dim=-1)
    return {
        "path": torch.stack(errors).mean() + height,
        "root": (_length(off) * share).sum(dim=1).mean(),
        "contacts": _average(nats, _weigh_frames(sequences.known) * truthful),
    }


def _compute_style_error(
    made: Float[Tensor, "batch frames joints 3"],
    wanted: Float[Tensor, "batch poses joints 3"],
    counts: Bool[Tensor, " batch"],
) -> Tensor:
    """How far the style's poses are from the nearest that are made and kept for some frames (Eq. 11), metres."""
    apart = torch.cdist(wanted.flatten(-2), made.flatten(-2)) / len(CANONICAL.names) ** 0.5
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=-1)
    return _average(nearest.mean(dim=-1), counts.float())


def _weigh_frames(known: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames"]:
    """1 at a key, half as much 2 s away from the nearest."""
    frame = torch.arange(known.shape[1])
    away = torch.minimum((frame - last_observed(known)).abs(), (next_observed(known) - frame).abs())
    return 1 / (1 + away / _HALF_WEIGHT_FRAMES)


def _between(weight: Float[Tensor, "batch frames"]) -> Tensor:
    return torch.minimum(weight[:, 1:], weight[:, :-1])


def _average(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1e-6)


def _length(vectors: Tensor) -> Tensor:
    """Length with a gradient at 0."""
    return vectors.square().sum(dim=-1).add(1e-8).sqrt()
