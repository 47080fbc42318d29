"""Captures whose noise lasts beyond a frame, from one end to the other, by the bundled denoiser, which knows walks."""

import pytest
import torch
from captures import error_cm, trembling
from helpers import bandai_skeleton, generator

import priors
from controllers.benchmarks.shared.corruptions import CONDITIONS, filter_noisy
from controllers.denoising.denoise import DenoiseSettings, denoise
from controllers.generation.generate import GenerateSettings, generate
from mapctl import retarget
from mapctl.motion import Motion
from mapctl.protocols import Denoiser
from mapctl.recording import Capture
from mapctl.recording.proposal import CaptureProposal

LASTING = [name for name in CONDITIONS if "last" in name or "filtered" in name]


@pytest.fixture(scope="module")
def denoiser():
    return priors.load_denoiser()


@pytest.fixture(scope="module")
def walk():
    """Drawn from the bundled density, as it comes."""
    settings = GenerateSettings(foot_cleanup=None, start=0)
    return generate(priors.load("locomotion"), seconds=4.0, generator=generator(3), settings=settings).motion


def on_rig(motion: Motion, rig: str, fps: int) -> Motion:
    if rig == "bandai":
        motion = retarget.from_canonical(motion, retarget.identify_rig(bandai_skeleton()))
    return motion.resample(fps)


@pytest.mark.parametrize(
    ("rig", "fps"), [("canonical", 30), ("bandai", 60), pytest.param("canonical", 120, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", LASTING)
def test_noise_that_lasts_is_found_told_and_taken_away(denoiser, walk, rig, fps, name):
    truth = on_rig(walk, rig, fps)
    given = CONDITIONS[name](truth, generator(1)).motion
    done = denoise(given, denoiser)
    assert error_cm(truth, done.motion) < 0.5 * error_cm(truth, given)
    told = torch.rad2deg(done.noise)
    assert float(told[told > 0].median()) > (1.8 if fps == 30 else 0.5)
    fixed = denoise(given, denoiser, settings=DenoiseSettings(sigma_deg=0.2, sigma_cm=0.1))
    assert error_cm(truth, fixed.motion) > 1.2 * error_cm(truth, done.motion)  # who says how noisy it is, is believed


@pytest.mark.parametrize(("rig", "fps"), [pytest.param("canonical", 30, marks=pytest.mark.slow), ("bandai", 60)])
def test_what_one_proposal_does_not_show_of_it_the_next_does(denoiser, walk, rig, fps):
    truth = on_rig(walk, rig, fps)
    given = filter_noisy(truth, generator(1), degrees=8.0, centimetres=3.2, hertz=6.0).motion
    assert error_cm(truth, denoise(given, denoiser).motion) < 0.33 * error_cm(truth, given)


class Spy(Denoiser):
    """Notes how noisy the hips are said to be."""

    def __init__(self, denoiser: Denoiser):
        self.denoiser, self.told = denoiser, []

    def clean(self, capture: Capture) -> CaptureProposal:
        self.told.append(float(capture.sigma_root))
        return self.denoiser.clean(capture)


@pytest.mark.parametrize("fps", [30, pytest.param(120, marks=pytest.mark.slow)])
def test_the_noise_of_the_hips_that_was_told_stays(denoiser, walk, fps):
    given, spies = CONDITIONS[LASTING[1]](on_rig(walk, "canonical", fps), generator(1)).motion, []
    for sigma_cm in (None, 1.0):
        spies.append(Spy(denoiser))
        denoise(given, spies[-1], settings=DenoiseSettings(sigma_cm=sigma_cm))
    own, told = (spy.told for spy in spies)
    assert own[-1] > 1.5 * own[0]
    assert len({round(each, 9) for each in told}) == 1


@pytest.mark.parametrize("degrees", [0.0, 5.0])
def test_white_noise_and_none_are_told_as_they_were_estimated(denoiser, walk, degrees, monkeypatch):
    given = trembling(walk, degrees * torch.pi / 180)
    done = denoise(given, denoiser)

    def keep(self, proposal: Motion, contacts: torch.Tensor) -> tuple[Motion, torch.Tensor]:
        return proposal, contacts

    monkeypatch.setattr("controllers.denoising.segment.SegmentDenoiser._propose_under_lasting_noise", keep)
    assert torch.equal(denoise(given, denoiser).motion.local_quat_xyzw, done.motion.local_quat_xyzw)
