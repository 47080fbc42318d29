"""A term that is written here, a hand's height at a time, goes through every job that solves."""

from dataclasses import dataclass, replace

import pytest
import torch
from captures import noisy, on_rig
from helpers import generator, walk
from linear_inbetweener import LinearInbetweener
from tiny_denoiser import tiny_denoiser
from toy_density import toy_density

from controllers.denoising.denoise import denoise
from controllers.generation.generate import GenerateSettings, generate
from controllers.inbetweening.blend import LimbTransfer, blend
from controllers.inbetweening.infill import chain, infill
from controllers.inbetweening.tween import tween
from controllers.shots.shot import follow
from controllers.steering import steer
from mapctl import curves, retarget
from mapctl.errors import RequestError
from mapctl.intent.keyframes import Keys
from mapctl.intent.steering import Command
from mapctl.recording.masks import ALL, Mask
from mapctl.skeleton import CANONICAL, Skeleton

TOY, SECONDS = toy_density(), 0.6
STEER = steer.SteerSettings(horizon=10, commit=5, evaluations=20)


@dataclass(frozen=True)
class HandHeight:
    """The left hand is at this height, metres, at this second of the motion."""

    height: float
    at: float = SECONDS
    sigma: float = 0.003
    name: str = "hand height"
    unit: str = "m"

    def __call__(self, trial):
        return 0.5 * (self.residual(trial) / self.sigma).square()

    def residual(self, trial):
        near = (trial.seconds - self.at).abs() < 0.5 / trial.fps
        return torch.where(near, (trial.joint_world("leftHand")[..., 1] - self.height).abs(), 0.0)


def steered(terms):
    state, first = steer.begin(TOY, Command(1.2, 0.0), generator=generator(), settings=STEER, terms=terms)
    pieces = [first]
    for _ in range(5):
        state, piece = steer.step(state, Command(1.2, 0.0))
        pieces.append(piece)
    whole = pieces[0].motion
    for piece in pieces[1:]:
        whole = whole.join(piece.motion)
    return replace(pieces[-1], motion=whole, ledger=pieces[4].ledger)


def drawn(terms):
    return generate(TOY, seconds=1.0, generator=generator(), terms=terms)


WALKER = on_rig("canonical", 40)
JOBS = {
    "follow": lambda terms: follow(TOY, curves.line(length=2), seconds=1, terms=terms, generator=generator()),
    "steer": steered,
    "generate": drawn,
    "denoise": lambda terms: denoise(noisy(WALKER), tiny_denoiser(), terms=terms),
    "tween": lambda terms: tween(WALKER, Keys((0, 39)), LinearInbetweener(), terms=terms),
    "infill": lambda terms: infill(WALKER, LinearInbetweener(), [Mask(ALL, 10, 30)], terms=terms),
    "infill, late": lambda terms: infill(
        walk(150), LinearInbetweener(), [Mask(ALL, 110, 130)], terms=[replace(term, at=4.0) for term in terms]
    ),
    "blend": lambda terms: blend(
        WALKER, walk(30), LimbTransfer(("leftHand",), 0, 5, 22, margin=0.4), LinearInbetweener(), terms=terms
    ),
    "chain": lambda terms: chain(
        [WALKER, WALKER], LinearInbetweener(), piece=12, gap=(12, 12), generator=generator(), terms=terms
    ),
}


def height_of(done, frame):
    """Height of the left hand, metres."""
    motion = retarget.to_canonical(done.motion)[0].resample(30)
    return float(motion.joint_positions()[frame, CANONICAL.index("leftHand"), 1])


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
def test_the_hand_is_higher_at_its_time_by_every_job(job):
    frame = round(30 * (4.0 if job == "infill, late" else SECONDS))
    plain = JOBS[job](())
    before = height_of(plain, frame)
    done = JOBS[job]((HandHeight(before + 0.03),))
    after = height_of(done, frame)
    assert after - before > 0.01, f"{1000 * (after - before):.0f} mm of 30"
    assert "hand height" in {entry.name for entry in done.ledger.entries}
    far = [abs(height_of(done, other) - height_of(plain, other)) for other in (1, 2)]
    assert max(far) < 0.01


@pytest.mark.slow
def test_terms_see_a_character_at_its_own_size():
    """Metres are the character's, whatever size the prior knows."""
    tall = Skeleton(CANONICAL.names, CANONICAL.parents, 1.5 * CANONICAL.offsets)
    make = lambda terms: follow(  # noqa: E731
        TOY, curves.line(length=2), seconds=1, terms=terms, generator=generator(), skeleton=tall
    )
    before = height_of(make(()), 18)
    done = make((HandHeight(before + 0.03),))
    assert height_of(done, 18) - before > 0.01
    (entry,) = [entry for entry in done.ledger.entries if entry.name == "hand height"]
    assert entry.unit == "m"
    assert float(entry.residual.max()) == pytest.approx(before + 0.03 - height_of(done, 18), abs=2e-3)


def test_terms_without_a_map_stage_to_join_are_refused():
    with pytest.raises(RequestError, match="terms belong to the MAP stage"):
        tween(WALKER, Keys((0, 39)), LinearInbetweener(), refinement=None, terms=[HandHeight(1.0)])
    with pytest.raises(RequestError, match="terms belong to the foot clean-up"):
        generate(
            TOY, seconds=1, generator=generator(), settings=GenerateSettings(foot_cleanup=None), terms=[HandHeight(1.0)]
        )
