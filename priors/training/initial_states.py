"""What a density takes with it from its data: moments to begin from, and what the data show to be possible."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.protocols import DataLimits, InitialStates
from priors.lstm_gmm.network import LstmGmm, LstmState
from priors.training.corpus import Corpus

_SECOND = PRIOR_FPS  # frames
_WARM_UP_FRAMES = 40  # frames of a clip before a start; the memory has settled by then


def select_initial_states(
    model: LstmGmm,
    corpus: Corpus,
    *,
    count: int,
    generator: torch.Generator,
    labels: Float[Tensor, "clips labels"] | None = None,
) -> InitialStates:
    """`count` moments of clips, or as many as there are clips; one a clip.

    Each combination of `labels` (1 where a label holds for a clip; default: none hold) gets its part of them by its
    frames, one at least where there are enough, spread evenly over its speeds.
    """
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
    strata = _number_strata(labels, len(features))
    frames = torch.tensor(corpus.lengths, dtype=torch.float32)
    frames_of, of_starts = torch.zeros(int(strata.max()) + 1).index_add_(0, strata, frames), strata[shuffled]
    clips_of = torch.bincount(of_starts, minlength=len(frames_of))
    picked = []
    for stratum, share in enumerate(_share_out(frames_of.tolist(), clips_of, count)):
        members = torch.nonzero(of_starts == stratum)[:, 0]
        picked += members[_select_by_speed(speeds[members], share)].tolist() if share else []
    states = [_state_after(model, features[shuffled[k]][: ends[k]]) for k in picked]
    state = LstmState(
        torch.cat([s.last_frame for s in states]),
        torch.cat([s.hidden for s in states], 1),
        torch.cat([s.cell for s in states], 1),
    )
    names = tuple(corpus.names[shuffled[k]] for k in picked)
    weights = _compute_weights(corpus, strata, speeds[picked], of_starts[picked])
    return InitialStates(state, speeds[picked], names, weights)


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


def _number_strata(labels: Tensor | None, clips: int) -> Int[Tensor, " clips"]:
    """Number of each clip's combination of labels."""
    if labels is None or labels.shape[1] == 0:
        return torch.zeros(clips, dtype=torch.long)
    return torch.unique(labels, dim=0, return_inverse=True)[1]


def _share_out(frames: Sequence[float], clips: Int[Tensor, " strata"], count: int) -> list[int]:
    """How many starts each stratum gets: one after the other goes to the one with most frames for each of its starts
    so far (Adams' rule of apportionment), so that none is left without while there are enough.
    """
    given = [0] * len(frames)
    for _ in range(min(count, int(clips.sum()))):
        open_ = [k for k in range(len(frames)) if given[k] < clips[k]]
        chosen = max(open_, key=lambda k: (given[k] == 0, frames[k] / max(1, given[k])))
        given[chosen] += 1
    return given


def _select_by_speed(speeds: Tensor, count: int) -> list[int]:
    """Indices whose speeds lie evenly between the slowest and the fastest."""
    low, high = speeds.quantile(0.02), speeds.quantile(0.98)
    free = torch.ones(len(speeds), dtype=torch.bool)
    picked = []
    # Half at even quantiles (common speeds), half at even steps of speed (rare ones too).
    rare = count // 2
    wanted = torch.cat([torch.quantile(speeds, _spread(count - rare)), low + (high - low) * _spread(rare)])
    for value in wanted[: int(free.sum())]:
        nearest = torch.where(free, (speeds - value).abs(), torch.inf).argmin()
        free[nearest] = False
        picked.append(int(nearest))
    return picked


def _spread(count: int) -> Float[Tensor, " count"]:
    """The middles of so many equal parts of 0 to 1."""
    return (torch.arange(count) + 0.5) / max(1, count)


def _compute_weights(
    corpus: Corpus, strata: Int[Tensor, " clips"], speeds: Float[Tensor, " starts"], of_starts: Int[Tensor, " starts"]
) -> Float[Tensor, " starts"]:
    """How much of the data is nearest to each start, clip by clip, every frame counting the same: of its stratum the
    one of the nearest speed, or of any where its stratum has none.
    """
    pace = torch.stack([ground_speed(clip).mean() for clip in corpus.clips()])
    apart = (pace[:, None] - speeds).abs().double()
    nearest = (apart + 1e6 * (strata[:, None] != of_starts)).argmin(-1)
    frames = torch.zeros(len(speeds)).index_add_(0, nearest, torch.tensor(corpus.lengths, dtype=torch.float32))
    return frames / frames.sum()


def _state_after(model: LstmGmm, clip: Float[Tensor, "frames size"]) -> LstmState:
    """Return the state after the whole clip."""
    with torch.no_grad():
        state = model.start_after(clip[:1])
        return model.advance(state, clip[1:].unsqueeze(0))
