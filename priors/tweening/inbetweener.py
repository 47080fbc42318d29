"""The tweener as an in-betweener: poses from the generator, the hips' way from the path predictor, exact keys."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.errors import CheckpointError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, PositionImage, Proposal
from mapctl.inbetweening.effector_targets import LooseKeys
from mapctl.inbetweening.query import GapSource
from mapctl.inbetweening.root_trajectory import TREMBLE_HZ, LocalMotion, lead_over_keys
from mapctl.inbetweening.whole_body import bend_limbs
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.motion_dna import MotionDna
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import interpolate_turns, smooth_between
from mapctl.protocols import Inbetweener, PathPredictor
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors import checkpoints
from priors.tweening import path as path_predictor
from priors.tweening.generator import MAX_KEY_FRAMES, GeneratorConfig, GeneratorNetwork
from priors.tweening.keys import bend_motion, see_contacts
from priors.tweening.styles import Style, read_classes


def show_loose_keys(image: PositionImage, loose: LooseKeys) -> PositionImage:
    """Show places over the ground, over which the reference of an image of one motion leads, and drawings in frames of
    which nothing else is known: from where the first of these is seen the reference then looks back, without turning.
    """
    axes, places = image.known_axes.clone(), image.places
    axes[0, loose.placed, 0, 0] = axes[0, loose.placed, 0, 2] = True
    seen = loose.see_from_one_side(CANONICAL)
    if seen is None:
        return replace(image, known_axes=axes)
    turned = replace(image, heading=torch.full_like(image.heading, seen.view))
    places = turned.from_world(image.to_world(places))
    open_frames = ~image.known[0].any(dim=-1) & loose.drawings
    shown = seen.known & open_frames[:, None, None]
    axes[0] |= shown
    places = torch.where(shown, seen.places.to(places), places[0])[None]
    return replace(turned, places=places, known_axes=axes)


PART_FRAMES = MAX_KEY_FRAMES // 2
"""Frames of the longest part of a gap that is split."""


@dataclass(frozen=True, eq=False)
class Split:
    """A gap that is longer than the network sees, and frames in it at which poses are told."""

    start: int
    """First frame of the gap."""
    stop: int
    """One past its last."""

    @property
    def frames(self) -> list[int]:
        """Frames at which poses are told, evenly from edge to edge."""
        parts = -(-(self.stop - self.start) // PART_FRAMES)
        return [self.start + round(part * (self.stop - self.start) / parts) for part in range(1, parts)]


def find_splits(query: GapQuery) -> Iterator[Split]:
    """Yield the gaps in which nothing is known and that are longer than the network sees."""
    for _, start, stop in true_intervals(query.nothing_known[:, None]):
        if stop - start > MAX_KEY_FRAMES:
            yield Split(start, stop)


def show_edges(query: GapQuery, split: Split) -> Float[Tensor, "poses joints 3"]:
    """Return the whole poses next to a gap, the one after it first, as motion DNA has them: metres from the hips,
    without the hips' rotation, of unit size. None where no pose is whole."""
    whole = (~query.missing.frames).nonzero()[:, 0]
    after, before = whole[whole >= split.stop], whole[whole < split.start]
    beside = torch.cat([after[:1], before[-1:]])
    upright = query.motion.local_quat_xyzw[beside].clone()
    upright[:, 0] = upright.new_tensor([0.0, 0.0, 0.0, 1.0])
    return kinematics.positions_from_matrices(CANONICAL, rotations.to_matrix(upright)).float()


def place_poses(
    poses: Float[Tensor, "poses joints 3"], body: Motion, frames: Sequence[int]
) -> Float[Tensor, "frames joints 3"]:
    """Place poses in these frames of a body that is led from key to key, turned to its heading there, the lower
    toe on the floor; spread over all of them, or one after the other and all over again if there are fewer. Metres,
    world."""
    count, there_are = len(frames), len(poses)
    picked = [one * there_are // count if count < there_are else one % there_are for one in range(count)]
    chosen = poses[picked].double()
    facing = heading(body.local_quat_xyzw[frames, 0])
    turned = rotations.rotate_about_y(chosen, facing[:, None])
    ground = body.root_position[frames] * torch.tensor([1.0, 0.0, 1.0]).double()
    lift = TOE_REST_HEIGHT - turned[:, list(TOE_JOINTS), 1].amin(dim=1)
    return turned + ground[:, None] + lift[:, None, None] * torch.tensor([0.0, 1.0, 0.0]).double()


SOURCE = "tweener"
"""Name of the in-betweener in notes."""
_MARGIN = 4
"""Frames that the network also answers for before the first frame and after the last: where its convolutions end, its
poses jump, and keys stand there."""
_FLICKER_HZ, _FLICKER_SHARE = 14.0, 0.5
"""Frequency of which half is taken from made rotations, and how far they follow: faster than 8 Hz they change more than
mocap's, and slower less."""
_KEY_SECONDS = 0.5  # over which what a key was missed by fades away from it


@dataclass(frozen=True, eq=False, repr=False)
class Tweener(checkpoints.LoadedModel, Inbetweener):
    """A trained generator of long in-betweens with the path predictor that it was trained with."""

    name: str
    """Name under which it was loaded."""
    network: GeneratorNetwork
    """Network in evaluation mode."""
    path: PathPredictor
    """Predictor of where the hips go."""
    card: checkpoints.Card
    """Card of the weights."""
    style: Style | None = field(default=None)
    """How to move; None leaves it to the keys."""
    classes: Mapping[str, Style] = field(default_factory=dict)
    """Styles that the weights know by name."""

    @property
    def has_style(self) -> bool:
        """Whether it was told how to move."""
        return self.style is not None

    @property
    def source(self) -> str:
        """Its name in notes."""
        return SOURCE if self.style is None else f"{SOURCE} in the style of {self.style.name}"

    def styled(self, dna: MotionDna) -> "Tweener":
        """Return the in-betweener that moves as a motion of which these are poses."""
        return self.in_style(self.encode_style(dna))

    def in_style(self, style: Style) -> "Tweener":
        """Return the in-betweener that moves in a style: one of `classes`, or what `encode_style` made."""
        return replace(self, style=style)

    @torch.no_grad()
    def encode_style(self, dna: MotionDna, name: str = "motion DNA") -> Style:
        """Encode poses of a motion as a style of this name."""
        return Style(name, self.network.style(dna.poses[None])[0], dna.poses)

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose poses of the whole motion at once, and lead the hips by them, without sampling.

        What keys were missed by is made good by the smoothest offsets of joints' rotations; what the way misses a known
        place by is spread in proportion to the way walked; hips do not tremble, and legs bend so that feet which stand
        stay there. Effector targets are ignored. Gaps that are longer than the network sees are split by poses of the
        style, or of the keys beside them.
        """
        shown, missing, splits = query.motion, query.missing, list(find_splits(query))
        told = self._tell_poses(query, splits)
        made, origin = self._make(query, told)
        met = interpolate_turns(made, shown.local_quat_xyzw, ~missing.joints, seconds=_KEY_SECONDS, fps=PRIOR_FPS)
        quats = torch.where(missing.joints[..., None], met, shown.local_quat_xyzw)
        body = query.to_unit_size(replace(shown, local_quat_xyzw=rotations.make_sign_continuous(quats)))
        body, logits = self._lead(body, query, origin)
        motion = query.to_character(body)
        root = torch.where(missing.root[:, None], motion.root_position, shown.root_position)
        motion = replace(motion, root_position=root)
        known = query.known_positions[:, list(TOE_JOINTS)]
        planted = contacts.to_logits(contacts.detect_contacts(body.joint_positions()[:, list(TOE_JOINTS)], PRIOR_FPS))
        return Proposal(
            motion, torch.where(known, planted, logits), self.source, tuple(self._tell_splits(query, splits, told))
        )

    def _make(
        self, query: GapQuery, told: Mapping[int, Float[Tensor, "joints 3"]]
    ) -> tuple[Float[Tensor, "frames joints 4"], Float[Tensor, " 3"]]:
        """Make rotations of all frames, near what is known and near poses that are given by frame, metres, world; also
        return the origin that these are seen from."""
        image, origin = _show(query, told)
        style = torch.zeros(self.network.config.style) if self.style is None else self.style.vector
        wide = image.extended(_MARGIN)
        made, inside = self.network(wide, style[None]), slice(_MARGIN, -_MARGIN)
        local = made.turn_to_world(wide).local_matrix[0, inside]
        return calm_poses(rotations.from_matrix(local.double())), origin

    def _tell_poses(self, query: GapQuery, splits: Sequence[Split]) -> dict[int, Float[Tensor, "joints 3"]]:
        """Choose the poses that split gaps, by frame, at their places in a motion of unit size, metres, world."""
        told = {}
        for split in splits:
            own = None if self.style is None else self.style.poses
            poses = show_edges(query, split) if own is None else own
            if len(poses):
                placed = place_poses(poses, _walk_over(query), split.frames)
                told |= dict(zip(split.frames, placed, strict=True))
        return told

    def _tell_splits(
        self, query: GapQuery, splits: Sequence[Split], told: Mapping[int, Float[Tensor, "joints 3"]]
    ) -> Iterator[GapSource]:
        """Tell which gaps are too long for the network, and when which poses split them."""
        by = "the keys beside it" if self.style is None or self.style.poses is None else "the style"
        for split in splits:
            times = ", ".join(f"{float(query.seconds[frame]):.1f}" for frame in split.frames if frame in told)
            reason = f"longer than the {MAX_KEY_FRAMES / PRIOR_FPS:.0f} s that the {SOURCE} sees; "
            reason += f"split at {times} s by poses of {by}" if times else "give more keys"
            yield GapSource(split.start, split.stop, self.source, reason)

    def _walk(self, body: Motion) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 2"]]:
        """Lead the hips by how the body moves, from the origin on, metres at unit size; also the contacts' logits."""
        facing = heading(body.local_quat_xyzw[:, 0])
        still = replace(body, root_position=torch.zeros_like(body.root_position))
        seen = still.joint_positions().float()[None]
        predicted = self.path.predict(LocalMotion.of_world(seen, facing.float()[None]))
        return predicted.integrate(facing.float()[None])[0].double(), predicted.contacts[0]

    def _lead(
        self, body: Motion, query: GapQuery, origin: Float[Tensor, " 3"]
    ) -> tuple[Motion, Float[Tensor, "frames 2"]]:
        """Lead the hips by how the body moves, from known position to known position, at unit size; also return the
        contacts' logits."""
        way, logits = self._walk(body)
        loose = None if query.loose is None else _shift(query.loose.scaled(1 / query.scale), -origin)
        led = lead_over_keys(way, body.root_position - origin, query.missing.root, loose)
        told = ~query.missing.root if loose is None else ~query.missing.root | loose.placed
        calm = smooth_between(led, told, hertz=TREMBLE_HZ, fps=PRIOR_FPS) + origin
        if query.keep_trajectory:
            calm = torch.cat([body.root_position[:, :1], calm[:, 1:2], body.root_position[:, 2:]], dim=-1)
            return replace(body, root_position=calm), logits
        made = replace(body, root_position=calm)
        share = torch.sigmoid(logits).double()
        return keep_feet(made, led + origin - calm, share, query), logits


def _show(query: GapQuery, told: Mapping[int, Float[Tensor, "joints 3"]]) -> tuple[PositionImage, Float[Tensor, " 3"]]:
    """Return the query, and poses that are told by frame, as the network takes it, of unit size and near the origin,
    and where that origin is."""
    body, known = _walk_over(query), _find_told_joints(query)
    placed = known[:, 0].nonzero()[:, 0]
    origin = body.root_position[placed[0] if len(placed) else 0] * torch.tensor([1.0, 0.0, 1.0]).double()
    places = body.joint_positions()
    planted = contacts.detect_contacts(places[:, list(TOE_JOINTS)], PRIOR_FPS).float()
    if told:
        places, known = places.clone(), known.clone()
        places[list(told)], known[list(told)] = torch.stack(list(told.values())), True
    image = PositionImage.of_world(
        (places - origin).float()[None],
        heading(body.local_quat_xyzw[:, 0]).float()[None],
        see_contacts(planted[None], known.any(dim=1)[None]),
        known=known[None],
        present=torch.ones(1, len(places), dtype=torch.bool),
        toes=TOE_JOINTS,
    )
    return (image if query.loose is None else show_loose_keys(image, query.loose)), origin


def calm_poses(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "frames joints 4"]:
    """Leave less of the fastest changes of rotations, which the network makes more of than performers do."""
    even = rotations.make_sign_continuous(quats)
    free = torch.zeros(len(even), dtype=torch.bool)
    calm = smooth_between(even.flatten(1), free, hertz=_FLICKER_HZ, fps=PRIOR_FPS).unflatten(1, even.shape[1:])
    return torch.nn.functional.normalize(torch.lerp(even, calm, _FLICKER_SHARE), dim=-1)


def _walk_over(query: GapQuery) -> Motion:
    """Return the query's motion at unit size, in whose gaps the hips go as who walks would."""
    missing = query.missing
    return bend_motion(query.to_unit_size(query.motion), placed=~missing.root, faced=~missing.joints[:, 0])


def _find_told_joints(query: GapQuery) -> Bool[Tensor, "frames joints"]:
    """Find the joints whose positions are told: in the world, or about hips of whose whole body the place alone is
    missing."""
    return query.known_positions | ~query.missing.joints.any(dim=1, keepdim=True)


def _shift(loose: LooseKeys, by: Float[Tensor, " 3"]) -> LooseKeys:
    return replace(loose, ground=loose.ground + by[::2])


def keep_feet(
    body: Motion, away: Float[Tensor, "frames 3"], planted: Float[Tensor, "frames 2"], query: GapQuery
) -> Motion:
    """Bend the legs of a body whose hips were moved so far from where planted feet want them, until these are where
    they were; `planted` from 0 to 1."""
    ends = body.joint_positions().clone()
    for foot, toe in enumerate(TOE_JOINTS):
        ends[:, CANONICAL.parents[toe]] += planted[:, foot, None] * away
    wanted = torch.zeros(ends.shape[:2], dtype=torch.bool)
    return bend_limbs(body, body, ends, wanted, query.missing.joints)


def load(name: str = "tweener", path: str = "path") -> Tweener:
    """Load the bundled tweener, or a trained one by its file or run folder, with the path predictor that it was trained
    with; CheckpointError for anything else, and for another path predictor."""
    with checkpoints.open_checkpoint(name, "tweener") as (tensors, card):
        network = checkpoints.build_network(GeneratorNetwork, GeneratorConfig.of_card(card.config), tensors)
        classes = read_classes(card, network.config.style)
    wanted, found = card.data.get("path"), checkpoints.compute_hash(path)
    if wanted != found:
        raise CheckpointError(
            f"{name} was trained with the path predictor {str(wanted)[:12]}; {path} is {found}: name it by --path"
        )
    return Tweener(name, network, path_predictor.load(path), card, classes=classes)
