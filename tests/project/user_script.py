"""A user's script over the public interface; `make check` reads it in strict mode, a slow test runs it."""

import sys
from dataclasses import dataclass

import torch

import controllers
import mapctl
import priors
from mapctl.terms import Trial


@dataclass(frozen=True)
class HandHeight:
    """The left hand is at this height, metres, at this second of the motion."""

    height: float
    at: float
    sigma: float = 0.01
    name: str = "hand height"
    unit: str = "m"

    def __call__(self, trial: Trial) -> torch.Tensor:
        return 0.5 * (self.residual(trial) / self.sigma).square()

    def residual(self, trial: Trial) -> torch.Tensor:
        near = (trial.seconds - self.at).abs() < 0.5 / trial.fps
        return torch.where(near, (trial.joint_world("leftHand")[..., 1] - self.height).abs(), 0.0)


def main(capture: str, out: str) -> None:
    noisy = mapctl.load(capture)
    clean = controllers.denoise(noisy, priors.load_denoiser())
    keys = controllers.Keys((0, clean.motion.num_frames - 1))
    tweened = controllers.tween(clean.motion, keys, priors.load_transformer(), terms=[HandHeight(1.2, at=1.0)])
    walk = controllers.follow(priors.load("locomotion"), mapctl.curves.circle(radius=2.0), seconds=2.0)
    for name, done in (("clean", clean), ("tweened", tweened), ("walk", walk)):
        worst = {term: values["residual_max"] for term, values in done.ledger.summary().items()}
        print(f"{name}: {done.status.text}; {done.motion.seconds:.1f} s; {worst}")
        done.motion.save(f"{out}-{name}.bvh")


if __name__ == "__main__":
    main(*sys.argv[1:3])
