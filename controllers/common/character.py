"""Characters of another size than the one a prior knows: the solve is at the prior's size, the motion at theirs.

A prior's steps, speeds and hip heights are those of the canonical body. For a character of other legs everything with a
length in it (curve, speed, sigmas) is divided by how much longer the legs are, and the motion is multiplied by it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

from mapctl import retarget
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.intent.steering import Command, SteeringLimits
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.protocols import DataLimits
from mapctl.retarget import RigMap
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton
from mapctl.terms import FootContact, Term
from mapctl.terms.base import ViewedTerm
from mapctl.terms.trial import Trial

_MIN_SCALE, _MAX_SCALE = 0.1, 10.0


@dataclass(frozen=True, eq=False)
class Character:
    """Whose bones move, and the rig that the motion is written on."""

    skeleton: Skeleton = CANONICAL
    """Canonical names and tree with the character's bones, metres."""
    toe_rest_height: float = TOE_REST_HEIGHT
    """Height of the character's toe joints while the foot stands flat, metres."""
    rigmap: RigMap | None = None
    """The way back to the rig; None for the canonical skeleton."""
    source: object | None = None
    """Layout and unit of the rig's clip, which the result is written in."""

    def __post_init__(self):
        if self.skeleton.names != CANONICAL.names or not _MIN_SCALE < self.scale < _MAX_SCALE:
            raise RequestError("a character needs the canonical joints, and legs of a human's length that hang down")

    @cached_property
    def scale(self) -> float:
        """How much longer the legs are than the canonical ones; 1 for the canonical body, exactly."""
        if self.skeleton is CANONICAL and self.toe_rest_height == TOE_REST_HEIGHT:
            return 1.0
        return (_hip_to_toe_height(self.skeleton) + self.toe_rest_height) / (
            _hip_to_toe_height(CANONICAL) + TOE_REST_HEIGHT
        )

    @cached_property
    def unit_skeleton(self) -> Skeleton:
        """The person's bones at the prior's size: only their proportions are the character's own."""
        if self.scale == 1.0:
            return self.skeleton
        ends = {
            name: (x / self.scale, y / self.scale, z / self.scale)
            for name, (x, y, z) in self.skeleton.end_offsets.items()
        }
        return Skeleton(CANONICAL.names, CANONICAL.parents, self.skeleton.offsets / self.scale, ends)

    def curve(self, curve: Curve) -> Curve:
        """A curve as the prior's size sees it."""
        return curve if self.scale == 1.0 else Curve(curve.points / self.scale, curve.closed)

    def data_limits(self, limits: DataLimits) -> DataLimits:
        """What the prior's data show, at the character's size."""
        if self.scale == 1.0:
            return limits
        return DataLimits(limits.slowest * self.scale, limits.fastest * self.scale, limits.turn_rate)

    def command(self, command: Command) -> Command:
        """A command as the prior's size sees it."""
        if self.scale == 1.0:
            return command
        step = None if command.step_length is None else command.step_length / self.scale
        return replace(command, speed=command.speed / self.scale, step_length=step)

    def limits(self, limits: SteeringLimits) -> SteeringLimits:
        """How fast wishes change, as the prior's size sees it."""
        return replace(limits, acceleration=limits.acceleration / self.scale, braking=limits.braking / self.scale)

    def footing(self, footing: FootContact) -> FootContact:
        """A footing term, whose rest height is the character's own, for the prior's size."""
        return replace(
            footing,
            sigma_speed=footing.sigma_speed / self.scale,
            sigma_height=footing.sigma_height / self.scale,
            sigma_below=footing.sigma_below / self.scale,
            rest_height=self.toe_rest_height / self.scale,
        )

    def motion(self, motion: Motion) -> Motion:
        """A motion of the prior's size on the character's bones."""
        if self.scale == 1.0:
            return motion
        return replace(motion, skeleton=self.skeleton, root_position=motion.root_position * self.scale)

    def ledger(self, ledger: Ledger) -> Ledger:
        """Residuals with a length in them in the character's metres."""
        if self.scale == 1.0:
            return ledger
        scaled = [
            replace(entry, residual=entry.residual * self.scale) if _is_length(entry.unit) else entry
            for entry in ledger.entries
        ]
        return Ledger(tuple(scaled))

    def term(self, term: Term) -> Term:
        """A caller's term, for the prior's size: it sees the character at its own size."""
        if self.scale == 1.0:
            return term
        # The ledger holds all lengths at the prior's size until `Character.ledger` brings them to the character's.
        return ViewedTerm(term, self.trial, 1 / self.scale if _is_length(term.unit) else 1.0)

    def trial(self, trial: Trial) -> Trial:
        """A trial of the prior's size at the character's own."""
        features = trial.features.clone()
        for block in ("root_displacement_heading", "root_height"):
            features[..., LAYOUT.slices[block]] *= self.scale
        start = replace(trial.start, position_xz=trial.start.position_xz * self.scale)
        before = trial.before * self.scale
        return replace(trial, features=features, start=start, before=before, skeleton=self.skeleton)

    def on_rig(self, motion: Motion) -> Motion:
        """A canonical motion of this character on its rig; fingers and whatever else is not canonical rest."""
        if self.rigmap is None:
            return motion
        return replace(retarget.from_canonical(motion, self.rigmap), source=self.source)


def _is_length(unit: str) -> bool:
    return unit.startswith(("m", "cm"))


def _hip_to_toe_height(skeleton: Skeleton) -> float:
    """How far below the hips the toe joints are in the rest pose, metres, mean of both."""
    bones = [side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")]
    return -float(skeleton.offsets[[skeleton.index(name) for name in bones], 1].sum()) / 2
