"""Solved shots and walks on the stage of a film, with what was asked of them."""

from collections.abc import Sequence

from controllers.shots.keys.posing import MetPose
from controllers.shots.request import Look, Reach
from mapctl import kinematics
from mapctl.commands.shared.path_walk import Walk
from mapctl.commands.shared.shots.play import PlayedShot
from mapctl.mesh.primitives import Surface
from scenes.drawn_character import DrawnCharacter
from scenes.props import build_hips_mark, build_look_mark, build_obstacle, build_target
from scenes.stage import Mark, Shot, Wishes


def stage_actor(
    done: Walk | PlayedShot,
    *,
    colour: str | None = None,
    start_seconds: float = 0.0,
    character: DrawnCharacter | None = None,
) -> Shot:
    """Put what an actor did on a stage, and what it was asked for: targets, places to look at, places and facings of
    the hips, and whole poses. It is drawn as a character if there is one."""
    wishes = _collect_wishes(done) if isinstance(done, PlayedShot) else Wishes()
    motion = done.solution.motion
    drawn = None if character is None else character.put_on(motion)
    return Shot(motion, done.request.curve, colour, start_seconds, wishes, drawn)


def print_notes(shots: Sequence[Shot]) -> None:
    """Print what could not be kept of motions that are drawn on characters."""
    for note in dict.fromkeys(note for shot in shots if shot.drawn is not None for note in shot.drawn.notes):
        print(f"note      the character that is drawn: {note}")


def build_obstacles(done: Sequence[Walk | PlayedShot]) -> list[Surface]:
    """Build every obstacle of some actors once."""
    shots = [one.request for one in done if isinstance(one, PlayedShot)]
    return [build_obstacle(each) for each in dict.fromkeys(each for request in shots for each in request.obstacles)]


def _collect_wishes(done: PlayedShot) -> Wishes:
    solution = done.solution
    marks = [
        Mark(build_target(place), _find_span(reach)) for reach in solution.reaches for place in reach.places.values()
    ]
    marks += [Mark(build_look_mark(look.place), _find_span(look)) for look in done.request.looks]
    marks += [_mark_hips(met) for met in solution.met if not met.key.tells_body]
    return Wishes(marks, [met.wanted for met in solution.met if met.key.tells_body])


def _mark_hips(met: MetPose) -> Mark:
    heading = float(kinematics.heading(met.wanted.local_quat_xyzw[0, 0])) if met.key.tells_facing else None
    return Mark(build_hips_mark(met.wanted.root_position[0, ::2].numpy(), heading), met.seconds)


def _find_span(key: Reach | Look) -> tuple[float, float]:
    return key.seconds, key.seconds + key.hold_seconds
