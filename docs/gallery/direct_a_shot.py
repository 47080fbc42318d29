"""
Direct a shot
=============

A shot has several requests that hold at once: here to set off from a stand, touch a ball with the left hand in passing,
walk round a pillar on the path, and come to a stop.
"""

import mapctl
import priors
from controllers.shots.request import Reach, ShotRequest
from controllers.shots.shot import solve_shot
from mapctl.curves.obstacles import Obstacle
from scenes import CameraSettings, Shot
from scenes.film import film
from scenes.overlays import build_obstacle, build_target
from scenes.stage import Mark, Targets

ball, pillar = (0.4, 1.25, 1.6), Obstacle(place=(0.05, 3.3), radius=0.3)
request = ShotRequest(
    mapctl.curves.line(length=4.6),
    stand_at_start=True,
    stand_at_end=True,
    reaches=(Reach(seconds=2.2, positions={"leftHand": ball}, hold_seconds=0.2),),
    obstacles=(pillar,),
)
shot = solve_shot(priors.load("locomotion"), priors.load_transformer(), request)

# %%
# Each request with its target and its result. Where one cannot hold, the status names what conflicts with it.

for constraint in shot.constraints:
    print(f"{constraint.name} ({constraint.asked}): {constraint.got:.1f} {constraint.unit}")
print(shot.status.text)

# %%
# The planned path (red) leads round the pillar. The ball shines while it is a target.

actor = Shot(shot.motion, shot.trajectory.curve, targets=Targets([Mark(build_target(ball), (2.2, 2.4))]))
camera, props = CameraSettings(azimuth_deg=65), [build_obstacle(pillar)]
film([actor], "reach-and-walk-round-a-pillar.webp", camera=camera, props=props, size=(480, 270), fps=15)
