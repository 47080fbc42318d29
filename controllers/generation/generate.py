"""Random generation of any length (Wang et al. 2019, sections 4.1.4, 4.2.3, 4.3 and 5.1).

The prior is sampled frame after frame, a refiner makes the samples look captured, and a foot clean-up plants feet where
the motion's own contact labels are 1. All three work piece by piece.
"""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.generation.foot_cleanup import FootCleanupSettings, clean_up_feet
from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.metrics.gait import find_pace, label_pace
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.problem.receding_horizon import CommittedFrames, replay
from mapctl.problem.solution import Ledger, Outcome, Solution, Status
from mapctl.protocols import Density, DensityState, Refiner
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton
from mapctl.terms import Term

_LOOK = 20  # frames after which is looked whether a pace has been taken on
# Times that a label counts at once; runs conditioned on it more often fling their legs.
_MOST_EMPHATIC = {"stand": 4, "walk": 4, "run": 2}
_WITHOUT_END = 3600 * PRIOR_FPS  # frames for which a pace lasts that the data never change


def draw_paces(
    rates: Mapping[tuple[str, str], float], first: str, generator: torch.Generator
) -> Iterator[tuple[str, int]]:
    """Draw paces one after the other, without end, and for how many frames each lasts: a Markov chain in continuous
    time, of the `rates` at which one pace (the first of a key) changes to another (the second), 1/s."""
    pace = first
    while True:
        changes = {after: rate for (before, after), rate in rates.items() if before == pace and rate > 0}
        if not changes:
            yield pace, _WITHOUT_END
            continue
        seconds = float(torch.empty(()).exponential_(sum(changes.values()), generator=generator))
        yield pace, max(1, round(seconds * PRIOR_FPS))
        pace = list(changes)[int(torch.multinomial(torch.tensor([*changes.values()]), 1, generator=generator))]


class PacePlan:
    """Conditions a prior on paces one after the other, with the more weight the longer it does not take one on.

    A label is a bias of the network's: given twice, it counts twice. Once the motion has the pace, once suffices.
    """

    def __init__(self, prior: Density, paces: Iterator[tuple[str, int]]):
        """`paces` and for how many frames each lasts, without end."""
        self._prior, self._paces = prior, paces
        self._pace, self._left = next(paces)
        self._emphasis = 1
        self._conditioned: dict[str, list[Density]] = {}
        # The frame before which each ends. What reads them is never far behind, if anything does.
        self._pieces = deque[tuple[int, Density]](maxlen=1000)
        self._seen = 0

    def condition(self) -> tuple[Density, int]:
        """Return the prior conditioned on the next pace, and for how many frames to sample it."""
        conditioned = self._conditioned.setdefault(self._pace, [self._prior])  # as many as their index
        while len(conditioned) <= self._emphasis:
            conditioned.append(conditioned[-1].conditioned_on([label_pace(self._pace)]))
        return conditioned[self._emphasis], min(self._left, _LOOK)

    def see(self, features: Float[Tensor, "frames size"]) -> None:
        """Go on after what was sampled."""
        self._seen += len(features)
        self._pieces.append((self._seen, self._conditioned[self._pace][self._emphasis]))
        self._left -= len(features)
        if self._left == 0:
            (self._pace, self._left), self._emphasis = next(self._paces), 1
            return
        has = find_pace(measure_net_speed(features))
        self._emphasis = 1 if has == self._pace else min(self._emphasis + 1, _MOST_EMPHATIC[self._pace])

    def find_prior(self, frame: int) -> Density:
        """Find the prior as conditioned when a frame was sampled, counted from 0; earlier frames are then forgotten."""
        while self._pieces[0][0] <= frame:
            self._pieces.popleft()
        return self._pieces[0][1]


def plan_paces(prior: Density, speed: float, generator: torch.Generator) -> PacePlan | None:
    """Plan the paces that a prior is conditioned on: from the pace of a mean `speed`, m/s, on, as often as its data
    change. None for a prior without labels of paces."""
    if not prior.pace_rates:
        return None
    return PacePlan(prior, draw_paces(prior.pace_rates, find_pace(speed), generator))


def measure_net_speed(features: Float[Tensor, "frames size"]) -> float:
    """Measure the speed of the net displacement of some frames, m/s: without the sway of a standing character."""
    return float(LAYOUT.pick(features, "root_displacement_heading").mean(0).norm()) * PRIOR_FPS


SIGMA_PLANTED = 0.05
"""Sigma of a planted toe's speed, m/s, with which samples slide about as mocap does; a smaller one shows."""
_CHUNK = 600
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class GenerateSettings:
    """How motion is sampled."""

    temperature: float = 1.0
    """Temperature of the samples: 0 is the prior's mean, 1 the prior itself."""
    start: int | None = None
    """Index of one of the prior's initial states; sampled by their weights if None."""
    condition_on_start: bool = True
    """Whether a prior with labels is conditioned on those of the initial state's clip (gait, style): unconditioned,
    one whose free runs no critic has judged lets most runs fall into a walk within ten seconds, as no clip does."""
    vary_paces: bool = True
    """Whether a prior with labels of paces is conditioned on one after the other, as often as its data change theirs:
    samples of a density hardly ever change theirs by themselves."""
    foot_cleanup: FootCleanupSettings | None = field(default_factory=FootCleanupSettings)
    """Settings of the foot clean-up; None leaves it out."""
    sigma_planted: float | None = None
    """Sigma of a planted toe's speed, m/s, given which frames are sampled; None samples them as they come."""

    def __post_init__(self):
        if not 0 <= self.temperature <= 2:
            raise RequestError(f"the temperature must lie between 0 and 2, got {self.temperature:g}")

    def character(self, skeleton: Skeleton) -> Character:
        """Return the character with these bones, and the toe height at rest of the foot clean-up."""
        return Character(skeleton, self.foot_cleanup.footing.rest_height if self.foot_cleanup else TOE_REST_HEIGHT)


def stream(
    prior: Density,
    *,
    seconds: float,
    generator: torch.Generator,
    settings: GenerateSettings | None = None,
    start_clip: Motion | None = None,
    refiner: Refiner | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
) -> Iterator[Solution]:
    """Generate consecutive pieces of one motion at PRIOR_FPS, at most 20 s each, so that memory does not grow with its
    length.

    Begins at the origin facing +Z, or at the end of `start_clip` (any known rig), whose frames warm up the state.
    On another `skeleton` (canonical names) strides are as long as its legs, and the toes' rest height is that of
    `settings.foot_cleanup`. `terms` are the caller's own, in every window of the foot clean-up; they see the character
    at its own size, in the world, and the time since the first frame. RequestError, at once, for an impossible length
    or start, and for terms without a foot clean-up.
    """
    settings, solved = settings or GenerateSettings(), list[CommittedFrames]()
    if terms and settings.foot_cleanup is None:
        raise RequestError("terms belong to the foot clean-up, which is left out")
    if not 0 < seconds < float("inf"):
        raise RequestError(f"seconds must be positive, got {seconds:g}")
    character, frames = settings.character(skeleton), max(2, round(seconds * PRIOR_FPS))
    beginning = initialise_generation(prior, settings, start_clip, generator, scale=character.scale)
    paces = plan_paces(beginning.prior, beginning.speed, generator) if settings.vary_paces else None
    pieces = sample_pieces(beginning, generator, settings, paces=paces)
    if refiner is not None:
        pieces = (piece[0] for piece in refiner.stream(piece.unsqueeze(0) for piece in pieces))
    if settings.foot_cleanup is not None:
        pieces = clean_up_feet(
            beginning.prior,
            pieces,
            frames=frames,
            state=beginning.state,
            generator=generator,
            ground_pose=beginning.ground_pose,
            settings=settings.foot_cleanup.scaled_to(character),
            skeleton=character.unit_skeleton,
            terms=[character.term(term) for term in terms],
            record=solved.append,
            find_prior=None if paces is None else paces.find_prior,
        )
    return _decode_pieces(_rechunk(pieces, frames), beginning.ground_pose, character, solved)


def generate(
    prior: Density,
    *,
    seconds: float,
    generator: torch.Generator,
    settings: GenerateSettings | None = None,
    start_clip: Motion | None = None,
    refiner: Refiner | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
) -> Solution:
    """Generate the whole motion at once; see `stream`."""
    pieces = stream(
        prior,
        seconds=seconds,
        generator=generator,
        settings=settings,
        start_clip=start_clip,
        refiner=refiner,
        skeleton=skeleton,
        terms=terms,
    )

    def join(whole: Solution, piece: Solution) -> Solution:
        assert whole.features is not None
        assert piece.features is not None
        return replace(
            whole,
            motion=whole.motion.join(piece.motion),
            ledger=whole.ledger.join(piece.ledger),
            windows=whole.windows + piece.windows,
            features=torch.cat([whole.features, piece.features]),
            seconds=whole.seconds + piece.seconds,
        )

    return reduce(join, pieces)


@dataclass(frozen=True)
class Beginning:
    """State from which generation continues."""

    prior: Density
    """The prior, conditioned on the labels of the initial state's clip if requested."""
    state: DensityState
    """Its state before the first frame, a batch of one."""
    ground_pose: GroundPose
    """The character's before the first frame, float64."""
    speed: float
    """Mean speed of the hips over the ground in the second before, m/s."""


def initialise_generation(
    prior: Density, settings: GenerateSettings, clip: Motion | None, generator: torch.Generator, *, scale: float = 1.0
) -> Beginning:
    """Begin at an initial state of the prior's, or unconditioned at the end of a clip, whose lengths are divided by
    `scale`, the ratio of its performer's size to the prior's. RequestError for a start that the prior does not have."""
    if clip is not None:
        canonical, _ = retarget.to_canonical(clip)
        if scale != 1.0:
            bones = replace(canonical.skeleton, offsets=canonical.skeleton.offsets / scale)
            canonical = replace(canonical, skeleton=bones, root_position=canonical.root_position / scale)
        features, ground_pose = encode(canonical.resample(PRIOR_FPS))
        ground, heading = integrate_root(features, ground_pose)
        observed = features.float()
        state = replay(prior, observed[1:], prior.start_after(observed[:1]))
        return Beginning(
            prior, state, GroundPose(ground[-1], heading[-1]), measure_net_speed(observed[1:][-PRIOR_FPS:])
        )
    speeds = prior.initial_states.speed
    count = len(speeds)
    if settings.start is not None and not 0 <= settings.start < count:
        raise RequestError(f"the prior has starts 0 to {count - 1}, got {settings.start}")
    sampled = int(torch.multinomial(prior.initial_states.weight, 1, generator=generator))
    pick = sampled if settings.start is None else settings.start
    state = prior.initial_states.state.pick(torch.tensor([pick]))
    prior = prior.conditioned_like_start(pick) if settings.condition_on_start else prior
    return Beginning(prior, state, GroundPose.origin(torch.float64), float(speeds[pick]))


def sample_pieces(
    beginning: Beginning,
    generator: torch.Generator,
    settings: GenerateSettings | None = None,
    *,
    paces: PacePlan | None = None,
) -> Iterator[Float[Tensor, "_ size"]]:
    """Sample consecutive pieces of one motion without end, conditioned on `paces`."""
    settings, prior, state = settings or GenerateSettings(), beginning.prior, beginning.state
    while True:
        conditioned, count = (prior, _CHUNK) if paces is None else paces.condition()
        draw = conditioned.sample
        if settings.sigma_planted is not None:
            draw = partial(conditioned.sample_planted, sigma_speed=settings.sigma_planted)
        features, state = draw(state, count, generator, temperature=settings.temperature)
        if paces is not None:
            paces.see(features[0])
        yield features[0]


def sample_stratified_starts(prior: Density, count: int, generator: torch.Generator) -> list[int]:
    """Sample an initial state for each of several motions, stratified over the data's speeds by weight.

    A golden-ratio sequence from a random first value, so that a few motions are already stratified, and the first of
    many are those of a few.
    """
    slow_to_fast = torch.argsort(prior.initial_states.speed)
    cumulative = prior.initial_states.weight[slow_to_fast].double().cumsum(0)
    first = torch.rand((), generator=generator, dtype=torch.float64)
    quantiles = torch.remainder(first + _GOLDEN * torch.arange(count, dtype=torch.float64), 1.0) * cumulative[-1]
    return slow_to_fast[torch.searchsorted(cumulative, quantiles).clamp(max=len(cumulative) - 1)].tolist()


def _rechunk(pieces: Iterable[Float[Tensor, "_ size"]], frames: int) -> Iterator[Float[Tensor, "_ size"]]:
    """Yield the first `frames` frames, _CHUNK at a time."""
    held = None
    for piece in pieces:
        held = piece if held is None else torch.cat([held, piece])
        while len(held) >= (count := min(frames, _CHUNK)):
            yield held[:count]
            held, frames = held[count:], frames - count
            if frames == 0:
                return


def _decode_pieces(
    pieces: Iterator[Float[Tensor, "_ size"]],
    ground_pose: GroundPose,
    character: Character,
    solved: list[CommittedFrames],
) -> Iterator[Solution]:
    """Decode pieces of features, each with the ledger of its frames and the windows solved for it."""
    ledger, began = Ledger(), time.perf_counter()
    for features in pieces:
        motion = character.motion(decode(features, ground_pose, skeleton=character.unit_skeleton))
        ground, heading = integrate_root(features.double(), ground_pose)
        ground_pose = GroundPose(ground[-1], heading[-1])
        for done in solved:
            ledger = ledger.join(done.ledger)
        windows, count = tuple(window for done in solved for window in done.windows), len(features)
        solved.clear()
        ledger_part, seconds = character.ledger(ledger.pick(slice(count))), time.perf_counter() - began
        yield Solution(motion, Status(Outcome.DONE), ledger_part, windows, features, seconds)
        ledger, began = ledger.pick(slice(count, None)), time.perf_counter()
