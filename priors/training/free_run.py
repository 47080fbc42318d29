"""Free-run health: does the density, sampled for long, stay a person moving as the data do?"""

import torch

from mapctl.features import ground_speed
from mapctl.metrics.states import summarise_states
from priors.lstm_gmm.network import LstmGmm
from priors.training.corpus import Corpus

_SETTLING_FRAMES = 300


def measure_free_runs(
    model: LstmGmm, corpus: Corpus, *, runs: int = 8, frames: int = 1500, temperature: float = 1.0, seed: int = 0
) -> dict[str, float]:
    """Speed, height and pose variation of free runs, each as a ratio to the corpus, and the slowest run's last speed.

    Runs begin after the first two seconds of clips; their first ten seconds are not counted.
    """
    clips = [clip for clip in corpus.clips() if len(clip) > 60]
    clips = [clips[i * len(clips) // runs % len(clips)] for i in range(runs)]
    state = model.start_after(torch.stack([clip[0] for clip in clips]).to(model.mean.device))
    state = model.advance(state, torch.stack([clip[1:60] for clip in clips]).to(model.mean.device))
    features, _ = model.sample(state, frames, torch.Generator().manual_seed(seed), temperature=temperature)
    settled = features[:, min(_SETTLING_FRAMES, frames // 2) :].cpu()
    own, wanted = summarise_states(settled.flatten(0, 1)), summarise_states(corpus.features)
    result = {f"free_run_{name}_ratio": own[name] / wanted[name] for name in own}
    result["free_run_slowest_m_s"] = float(ground_speed(settled[:, -150:]).mean(-1).min())
    result["free_run_finite"] = float(torch.isfinite(features).all())
    return result
