"""Robots that follow a character frame by frame: the last second is retargeted again with each frame that comes, and
what is shown lies a fixed delay before its end, so that a step is known before the foot is down. The search starts
from the frame before, frames that were shown are held, and feet that stood in them stay where they stood."""

from dataclasses import replace
from fractions import Fraction

from jaxtyping import Float
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.retarget import identify_rig
from mapctl.retarget.carry import retarget_canonical
from mapctl.retarget.character import RiggedCharacter, Stance
from mapctl.robots.model import Robot
from mapctl.robots.retarget import Observations, RobotMotion, minimise, observe, start_search
from mapctl.skeleton import Skeleton

DELAY_FRAMES = 6
"""Frames by which a robot is behind: 0.2 s at PRIOR_FPS."""
_MEMORY, _HELD = 30, 6  # frames that are carried again, and of those that were shown those that are held
_ITERATIONS = 5  # of a search


class RobotFollower:
    """A robot that does what a character on canonical joints does, at PRIOR_FPS."""

    def __init__(self, robot: Robot, skeleton: Skeleton):
        """Begin without frames; `skeleton` has the canonical joints with the character's bones."""
        self.robot, self._skeleton = robot, skeleton
        self._source = RiggedCharacter(identify_rig(skeleton), Stance.at_rest(skeleton))
        self._given: Motion | None = None
        self._total = self._shown = 0  # frames that were given, and that were shown
        self._solved: RobotMotion | None = None
        self._first = 0  # frame with which that begins

    def push(self, root: Float[Tensor, "frames 3"], quats: Float[Tensor, "frames joints 4"]) -> RobotMotion | None:
        """Take the next frames, hips in metres and local rotations (xyzw), Y up; return as many of the robot's, those
        DELAY_FRAMES before, or fewer at the beginning, None while there is none."""
        frames = Motion(self._skeleton, Fraction(PRIOR_FPS), root.double(), quats.double())
        given = frames if self._given is None else self._given.join(frames)
        memory = max(_MEMORY, len(root) + DELAY_FRAMES + _HELD)
        given = self._given = given.slice(max(0, given.num_frames - memory), given.num_frames)
        self._total += len(root)
        offset, stop = self._total - given.num_frames, self._total - DELAY_FRAMES
        if stop <= self._shown:
            return None
        first = max(offset, self._shown - _HELD)
        carried = retarget_canonical(given, self._source, self.robot.character).motion
        seen = observe(carried, self.robot).slice(first - offset, given.num_frames)
        now, held, iterations = start_search(self.robot, seen, given.fps), 0, None
        if self._solved is not None:
            known = self._solved.slice(first - self._first, None)
            later = now.slice(len(known.angles), None)
            known = known.join(replace(later, angles=known.angles[-1:].expand_as(later.angles)))
            held, iterations = self._shown - first, _ITERATIONS
            seen = _keep_footholds(seen, known.slice(held - 1, held), held)
            now = replace(known, contacts=seen.standing)
        self._solved, self._first = minimise(now, seen, held, iterations=iterations), first
        begin, self._shown = self._shown - first, stop
        return self._solved.slice(begin, stop - first)


def _keep_footholds(seen: Observations, shown: RobotMotion, held: int) -> Observations:
    """Keep feet that stand in the last frame that is held, and stood when it was shown, until they are lifted."""
    tips, (_, world) = shown.find_tips(), shown.chain_links()
    positions, orientations = seen.positions.clone(), seen.orientations.clone()
    for side, number in enumerate(seen.tips):
        stays = seen.standing[held - 1 :, side].cumprod(dim=0).bool() & shown.contacts[0, side]
        link, frames = seen.links[number], held - 1 + stays.nonzero()[:, 0]
        positions[frames, number, :2] = tips[0, side, :2]
        if seen.orientation_weights[held - 1, number] == seen.orientation_weights[:, number].amax():
            orientations[frames, number] = world[0, link]
    return replace(seen, positions=positions, orientations=orientations)
