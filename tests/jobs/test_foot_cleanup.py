"""The finishing pass: as long as asked, the same however it comes in, feet stiller, contacts steady."""

from dataclasses import replace

import pytest
import torch
from helpers import corpus, generator, tiny_density

from controllers.generation.foot_cleanup import FootCleanupSettings, clean_up_feet
from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.problem.receding_horizon import HorizonSettings
from mapctl.terms.trial import Trial

SETTINGS = FootCleanupSettings(window=HorizonSettings(frames=12, overlap=6))
DENSITY = tiny_density()


def clip(frames: int = 60, *, noise: float = 0.01) -> torch.Tensor:
    """A walk that trembles; its first frame is the state's."""
    features = corpus().clips()[1][:frames].clone()
    shake = noise * torch.randn(features.shape, generator=generator())
    features[:, : LAYOUT.continuous] += shake[:, : LAYOUT.continuous] * DENSITY.feature_std[: LAYOUT.continuous] / 0.05
    return features


def finished(pieces, frames, *, settings=SETTINGS):
    state = DENSITY.start_after(corpus().clips()[1][:1])
    return torch.cat(
        list(clean_up_feet(DENSITY, pieces, frames=frames, state=state, generator=generator(), settings=settings))
    )


def toe_speed(features: torch.Tensor) -> float:
    """Mean ground speed of planted toes, m/s, by the labels of the walk itself."""
    batch, bits = features[None], corpus().clips()[1][1 : len(features) + 1, -2:] > 0.5
    trial = replace(Trial.of_features(batch), contacts=bits[None])
    toes = torch.stack([trial.joint_world("leftToes"), trial.joint_world("rightToes")], 2)
    held = (bits[1:] & bits[:-1])[None]
    return float((30 * toes[..., ::2].diff(dim=1).norm(dim=-1))[held].mean())


@pytest.mark.parametrize("frames", [5, 12, 19])
def test_it_gives_as_many_frames_as_are_asked_for(frames):
    result = finished([clip()[1:]], frames)
    assert result.shape == (frames, LAYOUT.size)
    assert bool(torch.isfinite(result).all())


def test_planted_toes_slow_down_and_the_motion_stays_what_it_was():
    before = clip()[1:31]
    after = finished([clip()[1:]], 30)
    assert toe_speed(after) < 0.6 * toe_speed(before)
    height = LAYOUT.pick(after - before, "root_height")
    assert float(height.abs().mean()) < 0.03


def test_too_few_frames_to_look_ahead_are_refused():
    with pytest.raises(RequestError, match="needs 12 more frames"):
        finished([clip()[1:16]], 9 + 6)
