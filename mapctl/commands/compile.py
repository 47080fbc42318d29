"""`mapctl compile`: everything that is compiled once, now."""

import time
from dataclasses import dataclass
from typing import ClassVar

import torch

import priors
from controllers.shots.shot import follow
from controllers.steering import steer
from mapctl import curves
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.intent.steering import Command


@dataclass(frozen=True)
class CompileKernels(ModelCommand):
    """Compile the kernels and keep them on disk, so that the first motion does not wait for it; best after an
    installation."""

    prints_licence: ClassVar[bool] = False

    quiet: options.Quiet = False


def run(command: CompileKernels) -> int:
    """Run every job that has kernels of its own for a moment, which compiles those not yet on disk."""
    start = time.perf_counter()
    with outputs.show_progress("trying kernels", quiet=command.quiet):
        prior, ahead = priors.load("locomotion"), Command(1.0, 0.0)
        follow(prior, curves.line(length=1.0), seconds=0.1)
        generator = torch.Generator().manual_seed(0)
        state, _ = steer.begin(prior, ahead, generator=generator)
        steer.warm_up(state, [ahead])
        prior.sample(prior.initial_states.state.pick(torch.tensor([0])), 1, generator)
    if not command.quiet:
        print(f"kernels are compiled, {time.perf_counter() - start:.1f} s")
    return 0
