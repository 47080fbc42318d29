"""One instance of every term, and small densities: what the contract tests, and only they, must know of them."""

import math
from dataclasses import replace

import torch
from helpers import generator, tiny_density, tiny_model, walk
from linear_inbetweener import LinearInbetweener
from tiny_infiller import tiny_infiller
from tiny_refiner import refiner_of
from tiny_stitcher import tiny_stitcher
from tiny_transformer import tiny_transformer
from tiny_tweener import tiny_tweener
from toy_density import toy_density

from controllers.inbetweening.proposers import (
    AutoInbetweener,
    RolloutInbetweener,
    SlerpInbetweener,
    StitchedInbetweener,
)
from mapctl import curves
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.features import LAYOUT, GroundPose, encode, integrate_root
from mapctl.metrics.feet import locate_heels
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density, Inbetweener, Refiner
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import (
    Clearance,
    FootContact,
    Jerk,
    KeepApart,
    KeepClear,
    Keyframe,
    LandingSigmas,
    LatentPrior,
    Likelihood,
    MotionTracking,
    Path,
    RootVelocity,
    StepLength,
    Term,
    WithinReach,
)
from mapctl.terms.foot_contact import HeelSigmas
from mapctl.terms.trial import Trial
from priors.lstm_gmm.density import LstmGmmDensity
from priors.lstm_gmm.network import LstmGmm

FRAMES = 12
"""Frames of the windows on which terms are tried."""

PAST = 8
"""Frames before them."""

_ARCS = 0.3 + 0.04 * torch.arange(FRAMES, dtype=torch.float64)
_RISING = torch.linspace(0, 3, 400, dtype=torch.float64)
_IN_SPACE = curves.from_points(torch.stack([0.1 * torch.sin(_RISING), 0.1 + 0.2 * _RISING, _RISING], -1))

_VELOCITIES = torch.stack([torch.linspace(0, 0.4, FRAMES), torch.linspace(0, 1.2, FRAMES)], -1).double()

_FAR = torch.tensor([1.0, 1.5, 1.0]).expand(FRAMES, 3).double()

_MASK = torch.arange(FRAMES)[:, None] % (2 + torch.arange(21)) != 1

TERMS: dict[str, Term] = {
    "likelihood": Likelihood(temperature=2.0),
    "noise": LatentPrior(sigma=0.7),
    "noise about a draw": LatentPrior(0.7, torch.randn(FRAMES, LAYOUT.continuous, generator=generator(5))),
    "path of the hips": Path(curves.line(length=3), _ARCS),
    "path in space": Path(_IN_SPACE, _ARCS),
    "footing": FootContact(),
    "footing of landings": FootContact(9.0, 9.0, 9.0, heels=None, landing=LandingSigmas(10.0, 20.0)),
    "footing of heels": FootContact(9.0, 9.0, 9.0, heels=HeelSigmas(0.2, 0.05, 0.02, doubt=3.0)),
    "footing on supports": FootContact(supports=torch.linspace(0, 0.3, 2 * FRAMES).view(FRAMES, 2)),
    "steps": StepLength(0.6),
    "clearance": Clearance(height=0.2, share=torch.linspace(0.5, 1, 2 * FRAMES).view(FRAMES, 2)),
    "seam": Jerk(sigma=300.0),
    "closeness": MotionTracking(encode(walk(30, cadence=1.1, seed=4))[0][8 : 8 + FRAMES], sigma_heading=0.3),
    "keyframe": Keyframe(0.3 + 0.1 * torch.rand(FRAMES, 21, 3, generator=generator(9)).double(), _MASK, 0.1),
    "travel": RootVelocity(_VELOCITIES, _VELOCITIES[:9] - 0.2),
    "travel, facing": RootVelocity(_VELOCITIES, _VELOCITIES[:3], facing=4 * torch.arange(FRAMES).double()),
    "clear of a disc and a box": KeepClear((Obstacle((0.3, 0.8), 0.7), Obstacle((-0.4, 1.0), size=(0.6, 0.5)))),
    "apart": KeepApart(0.2 * torch.rand(2, FRAMES, 2, generator=generator(3)).double() + 0.5, 1.5),
    "within reach": WithinReach(6, _FAR, torch.arange(FRAMES) % 2 == 1, 0.5),
}
"""Names for the tests' output to instances; at least one of every class in `mapctl.terms`."""


def trial(batch=3, *, dtype=torch.float64, past=PAST, disturbed=0.05, seed=0):
    """Windows of a walk, each disturbed on its own, with the frames of the walk before it."""
    motion = walk(PAST + FRAMES, turn_rate=0.2)
    vectors, start = encode(motion)
    ground, heading = integrate_root(vectors[:PAST], start)
    scale = disturbed * vectors.std(0)
    features = vectors[PAST:] + scale * torch.randn(batch, FRAMES, LAYOUT.size, generator=generator(seed)).double()
    draw = torch.randn(batch, FRAMES, LAYOUT.continuous + 1, generator=generator(seed + 1)).double()
    bits = torch.rand(batch, FRAMES, 2, generator=generator(seed + 2)) < 0.6
    heels = torch.rand(batch, 1 + FRAMES, 2, generator=generator(seed + 3)) < 0.6
    position = GroundPose(ground[-1].to(dtype), heading[-1].to(dtype))
    before = motion.joint_positions()[PAST - past : PAST].to(dtype)
    planted = torch.tensor([True, False])
    return Trial(
        features.to(dtype),
        position,
        contacts=bits,
        noise=draw[..., 1:].to(dtype),
        log_density=30 * draw[..., 0].to(dtype),
        before=before,
        contacts_before=planted,
        heels_before=locate_heels(motion)[PAST - min(past, 1) : PAST].to(dtype),
        heel_contacts=heels,
    )


def excite(network: LstmGmm, seed: int) -> None:
    """Larger output weights, so that components and contact bits change along a rollout; values correlate."""
    with torch.no_grad():
        for values in (network.out.weight, network.out.bias):
            values += 0.3 * torch.randn(values.shape, generator=generator(seed), dtype=values.dtype)
        if network.config.correlated:
            values = network.correlation
            values += 0.1 * torch.randn(values.shape, generator=generator(seed), dtype=values.dtype)


def _lstm_gmm(dtype: torch.dtype = torch.float64, *, seed: int = 0, **shape) -> LstmGmmDensity:
    """A random network on the reference path."""
    network = tiny_model(seed=seed, dtype=dtype, **shape)
    excite(network, seed)
    return replace(tiny_density(dtype=dtype), reference=network)


DENSITIES: dict[str, Density] = {
    "one": _lstm_gmm(components=1),
    "several": _lstm_gmm(components=3, seed=1),
    "absolute": _lstm_gmm(components=2, seed=2, retain=0.0, correlated=False),
    "kernels": replace(_lstm_gmm(torch.float32, components=3, seed=1), use_fast=True),
    "toy": toy_density(torch.float64),
}
"""LSTM-GMM of one Gaussian, of several, and the paper's variant (absolute frames, diagonal Gaussians), on the reference
path; the second on the fast path; one that knows only `mapctl.protocols`; and one that returns its mean only."""

NETWORKS: dict[str, LstmGmm] = {
    kind: density.reference
    for kind, density in DENSITIES.items()
    if isinstance(density, LstmGmmDensity) and not density.use_fast
}
"""The networks of the reference path."""


class _Rounding(Refiner):
    """Contact bits are made hard, nothing else is changed."""

    def stream(self, pieces):
        for piece in pieces:
            yield torch.cat([piece[..., : LAYOUT.continuous], piece[..., LAYOUT.continuous :] > 0.5], dim=-1)


REFINERS: dict[str, Refiner] = {"lstm": refiner_of(), "toy": _Rounding()}
"""The LSTM of drawn weights, and one that knows only `mapctl.protocols`."""


_QUICK = LatentNoiseSolver(rounds=1, lbfgs=LbfgsSettings(max_iterations=3), budget=Budget(evaluations=8))
INBETWEENERS: dict[str, Inbetweener] = {
    "transformer": tiny_transformer(drawn=0.05),
    "infiller": tiny_infiller(drawn=0.02),
    "slerp": SlerpInbetweener(),
    "rollouts": RolloutInbetweener(
        [tiny_density()],
        SlerpInbetweener(),
        ahead=4,
        jump=math.inf,  # a small density of drawn weights does nothing else
        solver=_QUICK,
    ),
    "auto": AutoInbetweener(tiny_infiller(drawn=0.02), [tiny_density()]),
    "auto with the transformer": AutoInbetweener(tiny_transformer(drawn=0.05), [tiny_density()]),
    "tweener": tiny_tweener(),
    "auto with the tweener": AutoInbetweener(tiny_transformer(drawn=0.05), [tiny_density()], tweener=tiny_tweener()),
    "stitcher": StitchedInbetweener(tiny_stitcher(drawn=0.05), SlerpInbetweener),
    "linear": LinearInbetweener(),
}
"""One of each method, and one that knows only `mapctl.protocols`."""


def moved_curve(curve: Curve, turn: float, shift: tuple[float, float]) -> Curve:
    """The curve turned about +Y, then shifted over the ground."""
    angle = torch.tensor(turn, dtype=torch.float64)
    points = curve.points.clone()
    x, z = curve.points[:, 0], curve.points[:, -1]
    points[:, 0] = torch.cos(angle) * x + torch.sin(angle) * z + shift[0]
    points[:, -1] = torch.cos(angle) * z - torch.sin(angle) * x + shift[1]
    return Curve(points, curve.closed)
