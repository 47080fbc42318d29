"""Short windows along a circle, with an untrained density."""

import torch
from helpers import generator, tiny_density

from controllers.common.initial_state import select_initial_state
from mapctl import curves
from mapctl.problem.receding_horizon import HorizonSettings, RecedingHorizonSolver
from mapctl.problem.unknowns import WindowContext, WindowRequest
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.terms import FootContact, LatentPrior, Path

DENSITY = tiny_density()
CURVE = curves.circle(radius=2.0)
SHORT = HorizonSettings(frames=10, overlap=4, past=12)
METHOD = LatentNoiseSolver(rounds=2, budget=Budget(evaluations=12))
ARCS = 0.04 * torch.arange(80, dtype=torch.float64)


def terms_of(first, frames):
    return LatentPrior(), Path(CURVE, ARCS[first : first + frames]), FootContact()


def start(seed=0):
    found = select_initial_state(DENSITY, CURVE, ARCS, terms_of, skeleton=CANONICAL, generator=generator(seed))
    return found.committed


BEGUN = start()


def solver(method=METHOD, density=DENSITY, settings=SHORT):
    return RecedingHorizonSolver(density, settings, method=method)


def context(committed):
    return WindowContext(DENSITY, committed.state, committed.ground_pose, committed.joints_world, SHORT.frames)


def request(committed, terms, seed=0):
    return WindowRequest(context(committed), terms, committed.warm_start, generator(seed))
