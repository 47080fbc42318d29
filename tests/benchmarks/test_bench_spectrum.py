"""Speed by frequency: a swing is found in its band, bands add up to the mean square, and who trembles is told."""

import json
import math
from dataclasses import replace

import pytest
import torch
from helpers import run, walk
from tiny_path import save_tiny_path
from tiny_tweener import card, network

from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.spectrum import benchmark_spectrum
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import rotations
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.metrics.spectrum import BANDS_HZ, measure_speed_by_band
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from priors import checkpoints
from priors.checkpoints import compute_hash

RAW = InfillSettings(finish=False)
HZ = [f"{low:g}-{high:g}_hz" for low, high in BANDS_HZ]


class Trembling(Inbetweener):
    """Answers with a motion whose left forearm shakes at 10 Hz."""

    def __init__(self, truth: Motion):
        self.truth = truth

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        half = 0.1 * torch.sin(2 * math.pi * 10 * torch.arange(self.truth.num_frames, dtype=torch.float64) / 30)
        quats = self.truth.local_quat_xyzw.clone()
        shake = torch.stack([half.sin(), 0 * half, 0 * half, half.cos()], dim=-1)
        arm = self.truth.skeleton.index("leftLowerArm")
        quats[:, arm] = rotations.multiply(shake, quats[:, arm])
        made = replace(query.motion, root_position=self.truth.root_position, local_quat_xyzw=quats)
        return Proposal(made, estimate_contact_logits(made), "trembling")


@pytest.mark.parametrize(("hz", "band"), [(0.5, 0), (1.5, 1), (3.0, 2), (6.0, 3), (11.0, 4)])
def test_a_swing_is_found_in_its_band_at_its_root_mean_square(hz, band):
    seconds = torch.arange(301, dtype=torch.float64) / 30
    places = torch.zeros(301, 2, 3, dtype=torch.float64)
    places[:, 0, 1] = 0.1 * torch.sin(2 * math.pi * hz * seconds)
    found = measure_speed_by_band(places, 30)
    fastest = 100 * 0.1 * 2 * math.sin(math.pi * hz / 30) * 30  # cm/s, a sine's differences from frame to frame
    expected = fastest / 2  # root mean square over time, and one joint of two moves
    assert float(found[band]) == pytest.approx(expected, rel=0.02)
    assert all(float(each) < 0.02 * expected for number, each in enumerate(found) if number != band)


def test_bands_add_up_and_too_few_frames_are_refused():
    noise = torch.randn(400, 3, 3, generator=torch.Generator().manual_seed(1)).double()
    speed = 30 * 100 * torch.diff(noise, dim=0).square().sum(dim=-1).mean().sqrt()
    assert float(measure_speed_by_band(noise, 30).square().sum().sqrt()) == pytest.approx(float(speed), rel=0.05)
    with pytest.raises(ValueError, match="3 frames at least, got 2"):
        measure_speed_by_band(noise[:2], 30)


def test_who_trembles_is_told_from_mocap_and_from_slerp():
    motion = walk(110)
    methods = [Method("slerp", SlerpInbetweener(), RAW), Method("trembling", Trembling(motion), RAW)]
    mocap, slerp, trembling = benchmark_spectrum({"walks": [motion], "none": [walk(20)]}, methods, frames=108)
    assert [row["by"] for row in (mocap, slerp, trembling)] == ["mocap", "slerp", "trembling"]
    assert all(slerp[name] < 0.5 * mocap[name] for name in HZ[1:4])
    assert trembling[HZ[4]] > 2 * mocap[HZ[4]]
    assert trembling[HZ[1]] == pytest.approx(mocap[HZ[1]], rel=0.02)


def test_the_command_compares_frequencies_on_held_out_clips(tmp_path, capsys):
    data = tmp_path / "data"
    (data / "bandai").mkdir(parents=True)
    walk(70).save(data / "bandai" / "a_walk_1.bvh")
    predictor = str(save_tiny_path(tmp_path / "path.safetensors"))
    held = {"path": compute_hash(predictor), "held_out": {"validation": ["bandai/a_walk_1.bvh"], "test": []}}
    saved = tmp_path / "tweener.safetensors"
    checkpoints.save(network().state_dict(), replace(card(), data=held), saved)
    words = ["--part", "spectrum", "--tweener", saved, "--path", predictor, "--seconds", "2", "--raw", "--json"]
    assert run("bench", "tweener", "--data", data, *words) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["by"] for row in rows] == ["mocap", str(saved)]
    assert all(row[name] >= 0 for row in rows for name in HZ)
