"""Characters of another size than the prior's: the solve is at the prior's size, the motion at theirs.

A prior's steps, speeds and hip heights are those of the canonical body. For a character with other legs every length
(curve, speed, sigmas) is divided by the ratio of leg lengths, and the motion is multiplied by it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

from mapctl import retarget
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.intent.steering import Command, SteeringLimits, SteeringTarget
from mapctl.motion import Motion
from mapctl.problem.solution import Ledger
from mapctl.protocols import DataLimits
from mapctl.retarget import RigMap
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton
from mapctl.terms import FootContact, Term
from mapctl.terms.base import ViewedTerm
from mapctl.terms.trial import Trial

_MIN_SCALE, _MAX_SCALE = 0.1, 10.0


@dataclass(frozen=True, eq=False)
class Character:
    """Bones and stance of the character, and the rig on which its motion is written."""

    skeleton: Skeleton = CANONICAL
    """Canonical names and tree with the character's bones, metres."""
    toe_rest_height: float = TOE_REST_HEIGHT
    """Height of the character's toe joints while the foot stands flat, metres."""
    rigmap: RigMap | None = None
    """Map from canonical joints to the rig; None for the canonical skeleton."""
    source: object | None = None
    """Layout and unit of the rig's clip, in which the result is written."""

    def __post_init__(self):
        if self.skeleton.names != CANONICAL.names or not _MIN_SCALE < self.scale < _MAX_SCALE:
            raise RequestError("a character needs the canonical joints, and legs of a human's length that hang down")

    @cached_property
    def scale(self) -> float:
        """Ratio of the leg length to the canonical one; exactly 1 for the canonical body."""
        if self.skeleton is CANONICAL and self.toe_rest_height == TOE_REST_HEIGHT:
            return 1.0
        canonical = _hip_to_toe_height(CANONICAL) + TOE_REST_HEIGHT
        return (_hip_to_toe_height(self.skeleton) + self.toe_rest_height) / canonical

    @cached_property
    def unit_skeleton(self) -> Skeleton:
        """Skeleton at the prior's size with the character's proportions."""
        if self.scale == 1.0:
            return self.skeleton
        scale, ends = self.scale, self.skeleton.end_offsets
        ends = {name: (x / scale, y / scale, z / scale) for name, (x, y, z) in ends.items()}
        return Skeleton(CANONICAL.names, CANONICAL.parents, self.skeleton.offsets / scale, ends)

    def curve(self, curve: Curve) -> Curve:
        """Scale a curve to the prior's size."""
        return curve if self.scale == 1.0 else Curve(curve.points / self.scale, curve.closed)

    def data_limits(self, limits: DataLimits) -> DataLimits:
        """Scale the limits of the prior's data to the character's size."""
        return DataLimits(limits.slowest * self.scale, limits.fastest * self.scale, limits.turn_rate)

    def command(self, command: Command) -> Command:
        """Scale a command to the prior's size."""
        step = None if command.step_length is None else command.step_length / self.scale
        return replace(command, speed=command.speed / self.scale, step_length=step)

    def target(self, target: SteeringTarget) -> SteeringTarget:
        """Scale a steering target of the prior's size to the character's."""
        return replace(target, speed=target.speed * self.scale)

    def limits(self, limits: SteeringLimits) -> SteeringLimits:
        """Scale the limits of steering targets to the prior's size."""
        return replace(limits, acceleration=limits.acceleration / self.scale, braking=limits.braking / self.scale)

    def footing(self, footing: FootContact) -> FootContact:
        """Scale a contact term to the prior's size, with the character's own rest height."""
        sigmas = (footing.sigma_speed, footing.sigma_height, footing.sigma_below)
        scaled = footing.with_sigmas(*(sigma / self.scale for sigma in sigmas))
        landing = footing.landing and footing.landing.scale(1 / self.scale)
        return replace(scaled, landing=landing, rest_height=self.toe_rest_height / self.scale)

    def motion(self, motion: Motion) -> Motion:
        """Return a motion of the prior's size on the character's bones."""
        return replace(motion, skeleton=self.skeleton, root_position=motion.root_position * self.scale)

    def ledger(self, ledger: Ledger) -> Ledger:
        """Scale residuals that are lengths to the character's metres."""
        if self.scale == 1.0:
            return ledger
        scaled = [
            replace(entry, residual=entry.residual * self.scale) if _is_length(entry.unit) else entry
            for entry in ledger.entries
        ]
        return Ledger(tuple(scaled))

    def term(self, term: Term) -> Term:
        """View a caller's term at the prior's size, while it sees the character at its own size."""
        if self.scale == 1.0:
            return term
        # The ledger holds all lengths at the prior's size until `Character.ledger` brings them to the character's.
        return ViewedTerm(term, self.trial, 1 / self.scale if _is_length(term.unit) else 1.0)

    def trial(self, trial: Trial) -> Trial:
        """Scale a trial of the prior's size to the character's own."""
        features = trial.features.clone()
        for block in ("root_displacement_heading", "root_height"):
            features[..., LAYOUT.slices[block]] *= self.scale
        start = replace(trial.start, position_xz=trial.start.position_xz * self.scale)
        before, heels = trial.before * self.scale, trial.heels_before * self.scale
        return replace(
            trial,
            features=features,
            start=start,
            before=before,
            heels_before=heels,
            heel_plan=trial if trial.heel_plan is None else trial.heel_plan,
            skeleton=self.skeleton,
            world_poses=None,
        )

    def on_rig(self, motion: Motion) -> Motion:
        """Retarget a canonical motion of this character to its rig; joints that are not canonical rest."""
        if self.rigmap is None:
            return motion
        return replace(retarget.from_canonical(motion, self.rigmap), source=self.source)


def _is_length(unit: str) -> bool:
    return unit.startswith(("m", "cm"))


def _hip_to_toe_height(skeleton: Skeleton) -> float:
    """Compute the height of the hips above the toe joints in the rest pose, metres, mean of both."""
    bones = [side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot", "Toes")]
    return -float(skeleton.offsets[[skeleton.index(name) for name in bones], 1].sum()) / 2
