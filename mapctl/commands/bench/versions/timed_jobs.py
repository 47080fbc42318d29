"""A program that times jobs of the mapctl it finds on its path, once for each line of its input; run by `alternate`.

It uses only names that versions have in common, so that it can time one that is older than itself.
"""

import math
import sys
import time

import torch

import priors
from controllers.following.follow import follow
from controllers.steering import steer
from mapctl import curves
from mapctl.intent.steering import Command

_STEPS, _SECONDS, _WARM_UP = 40, 4.0, 5


def main() -> None:
    """Answer each line with the milliseconds a frame of steering and of following, processor time."""
    torch.set_num_threads(1)
    live, walks = priors.load("locomotion-live"), priors.load("locomotion")
    state, _ = steer.begin(live, Command(1.2, 0.0), generator=torch.Generator().manual_seed(0))
    for _ in range(_WARM_UP):
        state, _ = steer.step(state, Command(1.2, 0.0))
    _time_following(walks)
    print("ready", flush=True)
    for _ in sys.stdin:
        print(_time_steering(state), _time_following(walks), flush=True)


def _time_steering(state: steer.SteerState) -> float:
    began, frames = time.process_time(), 0
    for number in range(_STEPS):
        state, new = steer.step(state, Command(1.2, 0.3 * math.sin(number / 20)))
        frames += new.motion.num_frames
    return 1000 * (time.process_time() - began) / frames


def _time_following(prior: object) -> float:
    began = time.process_time()
    generator = torch.Generator().manual_seed(0)
    walk = follow(prior, curves.circle(radius=4.0), seconds=_SECONDS, generator=generator)  # type: ignore[arg-type]
    return 1000 * (time.process_time() - began) / walk.motion.num_frames


if __name__ == "__main__":
    main()
