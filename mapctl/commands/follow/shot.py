"""A walk of which more is wished than to follow its curve: a shot of one actor."""

from fractions import Fraction
from pathlib import Path

from controllers.common.character import Character
from mapctl.commands.follow import FollowCurve
from mapctl.commands.shared.shots.plan import ShotPlan, plan_shot
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.shot_keys import read_shot_keys
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.scene_file import Actor


def plan(command: FollowCurve, curve: Curve, prior: LstmGmmDensity, character: Character) -> ShotPlan:
    """Plan the shot that the options describe; files are relative to the working directory."""
    actor = Actor(
        curve=command.curve,
        speed=command.speed,
        seconds=command.seconds,
        seed=command.seed,
        gait=command.gait,
        style=command.style,
        start=command.start,
        end=command.end,
        loop=command.loop,
        keys=() if command.keys is None else read_shot_keys(command.keys),
    )
    if actor.fault is not None:
        raise RequestError(f"--{actor.fault}")
    obstacles = [Obstacle.parse(text) for text in command.avoid]
    fps = None if command.fps is None else Fraction(command.fps).limit_denominator(100_000)
    return plan_shot(
        actor, curve, prior, character=character, folder=Path(), options=command, obstacles=obstacles, fps=fps
    )
