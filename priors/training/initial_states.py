"""What a density takes with it from its data: moments to begin from, and what the data show to be possible."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.protocols import DataLimits, InitialStates
from priors.lstm_gmm.network import LstmGmm, LstmState
from priors.training.corpus import Corpus

_SECOND = PRIOR_FPS  # frames
_WARM_UP_FRAMES = 40  # frames of a clip before a start; the memory has settled by then


def select_initial_states(model: LstmGmm, corpus: Corpus, *, count: int, generator: torch.Generator) -> InitialStates:
    """`count` moments spread evenly over the speeds of the corpus, or as many as there are clips; one a clip."""
    clips = [i for i, length in enumerate(corpus.lengths) if length > _WARM_UP_FRAMES + _SECOND]
    features = corpus.clips()
    shuffled = [clips[i] for i in torch.randperm(len(clips), generator=generator).tolist()]
    ends = [
        _WARM_UP_FRAMES
        + int(torch.randint(len(features[i]) - _WARM_UP_FRAMES - _SECOND // 2, (1,), generator=generator))
        for i in shuffled
    ]
    speeds = torch.stack(
        [ground_speed(features[i][end - _SECOND : end]).mean() for i, end in zip(shuffled, ends, strict=True)]
    )
    picked = _select_by_speed(speeds, count)
    states = [_state_after(model, features[shuffled[k]][: ends[k]]) for k in picked]
    state = LstmState(
        torch.cat([s.last_frame for s in states]),
        torch.cat([s.hidden for s in states], 1),
        torch.cat([s.cell for s in states], 1),
    )
    names = tuple(corpus.names[shuffled[k]] for k in picked)
    return InitialStates(state, speeds[picked], names, _compute_weights(corpus, speeds[picked]))


def measure_data_limits(corpus: Corpus) -> DataLimits:
    """Percentiles of one-second means of speed and of the turning of the travel direction."""
    speeds, turns = [], []
    for clip in corpus.clips():
        if len(clip) <= 2 * _SECOND:
            continue
        ground, _ = integrate_root(clip.double(), GroundPose.origin(torch.float64))
        velocity = ground[_SECOND:] - ground[:-_SECOND]  # metres in one second
        pace = velocity.norm(dim=-1)
        direction = torch.atan2(velocity[:, 0], velocity[:, 1])
        turn = rotations.wrap_angle(direction[_SECOND:] - direction[:-_SECOND])
        speeds.append(pace)
        turns.append(turn.abs()[pace[_SECOND:] > 0.5])
    speeds, turns = torch.cat(speeds), torch.cat(turns)
    turn_rate = float(turns.quantile(0.995)) if len(turns) else 0.0  # nobody may walk in the data
    return DataLimits(float(speeds.quantile(0.01)), float(speeds.quantile(0.99)), turn_rate)


def _select_by_speed(speeds: Tensor, count: int) -> list[int]:
    """Indices whose speeds lie at even quantiles between the slowest and the fastest."""
    low, high = speeds.quantile(0.02), speeds.quantile(0.98)
    free = torch.ones(len(speeds), dtype=torch.bool)
    picked = []
    # Half at even quantiles (common speeds), half at even steps of speed (rare ones too).
    wanted = torch.cat(
        [
            torch.quantile(speeds, torch.linspace(0.02, 0.98, count - count // 2)),
            torch.linspace(float(low), float(high), count // 2),
        ]
    )
    for value in wanted[: int(free.sum())]:
        nearest = torch.where(free, (speeds - value).abs(), torch.inf).argmin()
        free[nearest] = False
        picked.append(int(nearest))
    return picked


def _compute_weights(corpus: Corpus, speeds: Float[Tensor, " starts"]) -> Float[Tensor, " starts"]:
    """How much of the data has a speed that is nearest to each start's, clip by clip, every frame counting the same."""
    pace = torch.stack([ground_speed(clip).mean() for clip in corpus.clips()])
    nearest = (pace[:, None] - speeds).abs().argmin(-1)
    frames = torch.zeros(len(speeds)).index_add_(0, nearest, torch.tensor(corpus.lengths, dtype=torch.float32))
    return frames / frames.sum()


def _state_after(model: LstmGmm, clip: Float[Tensor, "frames size"]) -> LstmState:
    """Return the state after the whole clip."""
    with torch.no_grad():
        state = model.start_after(clip[:1])
        return model.advance(state, clip[1:].unsqueeze(0))
