"""
Steer from a loop
=================

In a game or on a robot, commands arrive at run time. A step of steering computes the next three frames under the
present command; `drive` is the loop around it, which polls a source for commands and sends frames to displays.
"""

import math

import matplotlib.pyplot as plt
import torch

import priors
from controllers import steer
from controllers.steering.loop import Recorder, StreamClock, drive, summarise_step_timing
from mapctl.intent.steering import Command, CommandTrack
from scenes import CameraSettings, Shot
from scenes.film import film

# A source is a function of seconds: a gamepad, a planner, or as here a script. Ahead, left, faster, stop.
orders = {0.0: (1.2, 0), 1.5: (1.2, 100), 3.0: (2.4, 100), 4.5: (0.0, 100)}
commands = [Command(speed, heading=math.radians(degrees)) for speed, degrees in orders.values()]
script, recorder, generator = CommandTrack((*orders,), (*commands,)), Recorder(), torch.Generator().manual_seed(3)
state, pose = steer.begin(priors.load("locomotion-live"), script.at(0.0), generator=generator)
recorder.show(pose, 0.0)
state, records = drive(state, script.at, [recorder.show], frames=180, clock=StreamClock())  # WallClock(): in real time
print(f"an order shows after {summarise_step_timing(records)['command_latency_s']:.2f} s at the latest")
motion, camera = recorder.motion(), CameraSettings("follow", azimuth_deg=-30)
film([Shot(motion)], "ahead-left-faster-stop.webp", camera=camera, size=(400, 225), fps=12)

# %%
# Orders come at once; a body speeds up and stops step by step.

walked = (motion.root_position[1:, ::2] - motion.root_position[:-1, ::2]).norm(dim=-1) * float(motion.fps)
seconds = [frame / float(motion.fps) for frame in range(len(walked))]
plt.plot(seconds, [script.at(at).speed for at in seconds], color="#999999", label="ordered")
plt.plot(seconds, walked, label="walked")
plt.gca().set(title="Speed", xlabel="seconds", ylabel="m/s")
plt.legend()
