"""What a density is worth on held-out clips: likelihood, and whether, sampled for long, it stays a person
moving as the data do.
"""

import math
from collections.abc import Iterable
from typing import Any

import torch

from mapctl.features import GroundPose, ground_speed
from mapctl.metrics import compute_reference
from mapctl.metrics.states import summarise_states
from mapctl.pose import decode
from mapctl.problem import density_selection
from priors.lstm_gmm.network import LstmGmm
from priors.training.corpus import Corpus, Split
from priors.training.devices import make_generator

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
    features, _ = model.sample(state, frames, make_generator(seed), temperature=temperature)
    settled = features[:, min(_SETTLING_FRAMES, frames // 2) :].cpu()
    own, wanted = summarise_states(settled.flatten(0, 1)), summarise_states(corpus.features)
    result = {f"free_run_{name}_ratio": own[name] / wanted[name] for name in own}
    result["free_run_slowest_m_s"] = float(ground_speed(settled[:, -150:]).mean(-1).min())
    result["free_run_finite"] = float(torch.isfinite(features).all())
    return result


def measure_quality(model: LstmGmm, parts: Split) -> dict[str, Any]:
    """Measure the quality of a finished network, for its card."""
    return {
        "test_nats_per_frame": compute_validation_nats(model, parts.test),
        "windows": compute_window_nats(model, (parts.validation, parts.test)),
        "mocap": _measure_mocap(parts),
        "data": summarise_states(parts.train.features),
    }


def _measure_mocap(parts: Split) -> dict[str, dict[str, float]]:
    """What the clips kept from training show in every measure: mean, 2nd and 98th percentile (NaN left out)."""
    held = [decode(clip, GroundPose.origin()) for part in (parts.validation, parts.test) for clip in part.clips()]
    table = {name: spread._asdict() for name, spread in compute_reference(held).items()}
    return {name: row for name, row in table.items() if not math.isnan(row["mean"])}


def compute_validation_nats(model: LstmGmm, corpus: Corpus, frames: int = 100) -> float:
    """Mean negative log density a frame over the first frames of every clip, clean inputs, from an empty memory."""
    total, count = 0.0, 0
    with torch.no_grad():
        for clip in corpus.clips():
            clip = clip[:frames].unsqueeze(0).to(model.mean.device)
            nats = -model.log_prob(clip[:, 1:], model.start_after(clip[:, 0]))
            total, count = total + nats.sum().item(), count + nats.numel()
    return total / count


def compute_window_nats(model: LstmGmm, corpora: Iterable[Corpus]) -> dict[str, float]:
    """Log density a frame, physical units, of motion as wrong as a proposal is: mean over windows, and the value that
    98 % of them reach. By it a density's trust is told (see mapctl.problem.density_selection); clips begin with an
    empty memory.
    """
    blurred, found = model.cpu().with_observation_noise(density_selection.proposal_sigma()), []
    with torch.no_grad():
        for clip in (clip for corpus in corpora for clip in corpus.clips() if len(clip) > 1):
            nats = blurred.log_prob(clip[None, 1:], blurred.start_after(clip[:1]))[0]
            parts = density_selection.to_physical_log_density(nats, blurred.std).split(
                density_selection.SELECTION_WINDOW
            )
            found += [
                part.mean() for part in parts if len(part) == density_selection.SELECTION_WINDOW or len(parts) == 1
            ]
    values = torch.stack(found)
    return {"mean": float(values.mean()), "p2": float(values.quantile(0.02))}
