"""
Search with a swarm
===================

The search for a walk begins at the prior's own continuation. Where a curve turns back sharply, a particle swarm that
flies before the gradient is followed may find a better basin. It costs its evaluations.
"""

import matplotlib.pyplot as plt
import torch

import controllers
import mapctl
import priors
from mapctl.problem.warm_start import SwarmProposal
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.solver.budget import Budget
from scenes import CameraSettings, Shot
from scenes.film import film

swarm = LatentNoiseSolver(proposal=SwarmProposal(), budget=Budget(evaluations=216))
prior, back, shots = priors.load("locomotion"), torch.tensor([[0.0, 0.0], [0.0, 2.0], [1.5, 0.5]]), []
for place, (name, method) in enumerate({"zero start": LatentNoiseSolver(), "swarm": swarm}.items()):
    curve, colour = mapctl.curves.from_points(back + torch.tensor([2.2 * place, 0.0])), ("#999999", "#4c78a8")[place]
    settings, energies = controllers.FollowSettings(method=method), []
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        walk = controllers.follow(prior, curve, seconds=3.5, settings=settings, generator=generator)
        energies.append(sum(walk.ledger.summary()[term]["energy_nats"] for term in ("path", "footing")))
        shots.append(Shot(walk.motion, curve, colour))
    print(f"{name}: {sum(window.evaluations for window in walk.windows)} evaluations for the last of its walks")
    plt.bar(torch.arange(3) + 0.4 * place - 0.2, energies, width=0.4, color=colour, label=name)
plt.gca().set(title="Energy of path and footing: less is better", xlabel="seed", ylabel="nats", xticks=range(3))
plt.legend()
camera = CameraSettings(azimuth_deg=0)
film([shots[0], shots[3]], "without-and-with-a-swarm.webp", camera=camera, size=(480, 270), fps=15)

# %%
# The film shows seed 0. On gentle curves a swarm gains nothing (:doc:`/reference/results`): zero start is the default.
