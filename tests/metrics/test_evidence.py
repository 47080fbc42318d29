"""What gives made motion away: causes that are planted in copies of walks are named, and none where there is none."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from helpers import generator, walk, walk_through
from torch import Tensor

from mapctl.metrics import realism
from mapctl.metrics.realism.evidence import alone, kinds, parts, paths
from mapctl.metrics.realism.windows import WindowSettings, cut_windows
from mapctl.numerics.easing import smootherstep
from mapctl.skeleton import CANONICAL

WINDOWS = WindowSettings()
SETTINGS = realism.RealismSettings(
    classifier=realism.ClassifierSettings(folds=2, steps=200, width=16, batch=32, learning_rate=3e-3), dims=8
)
WRIST, HEAD, CHEST = (CANONICAL.index(name) for name in ("leftHand", "head", "chest"))
LEFT_FOOT = [CANONICAL.index(name) for name in ("leftFoot", "leftToes")]


@cache
def clean(count: int = 12, frames: int = 95, seed: int = 0) -> tuple[Tensor, ...]:
    """Positions of straight walks of different cadence, whose feet are planted for six tenths of a stride."""
    cadences = (0.7 + 0.4 * torch.rand(count, generator=generator(seed))).tolist()
    return tuple(step_out(walk(frames, cadence=cadence).joint_positions(), cadence) for cadence in cadences)


def step_out(clip: Tensor, cadence: float) -> Tensor:
    """Put the feet where the hips are amid each stance, and lift them from one such place to the next."""
    stepped, hips = clip.clone(), clip[:, 0, 2]
    speed = float(hips[-1] - hips[0]) * 30 / (len(clip) - 1)
    for side, offset, aside in (("left", 0.0, 0.1), ("right", 0.5, -0.1)):
        strides = torch.arange(len(clip)) * cadence / 30 + offset
        share = ((strides % 1 - 0.6) / 0.4).clamp_min(0).double()
        ahead = (strides.floor() + 0.3 - offset + smootherstep(share)) * speed / cadence
        foot, toes = (CANONICAL.index(f"{side}{name}") for name in ("Foot", "Toes"))
        stepped[:, toes] = torch.stack(
            [0 * share + aside, 0.04 + 0.1 * torch.sin(math.pi * share), ahead + 0.09], dim=-1
        )
        stepped[:, foot] = stepped[:, toes] + torch.tensor([0.0, 0.075, -0.09]).double()
    return stepped


def explain(made, mocap, *, settings=SETTINGS):
    windows = [[realism.cut_windows(clip) for clip in clips] for clips in (made, mocap)]
    judges = realism.train_judges(*windows, generator=generator(1), settings=settings)
    looked_into = realism.EvidenceSettings(windows=60, partners=1, steps=4)
    return judges.explain(made, mocap, generator=generator(2), settings=looked_into)


def sine(clip: Tensor, hertz: float, phase: float = 0.0) -> Tensor:
    return torch.sin(2 * math.pi * hertz * torch.arange(len(clip), dtype=torch.float64) / 30 + phase)


def jittery_wrist(clip: Tensor) -> Tensor:
    """A wrist that trembles sideways by 5 mm at 8 Hz."""
    spoilt = clip.clone()
    spoilt[:, WRIST, 0] += 0.005 * sine(clip, 8.0)
    return spoilt


def lowered_head(clip: Tensor) -> Tensor:
    """A head that is 2 cm lower throughout."""
    spoilt = clip.clone()
    spoilt[:, HEAD, 1] -= 0.02
    return spoilt


def below(joint: int) -> list[int]:
    return [k for k in range(CANONICAL.num_joints) if parts.ANCESTORS[k, joint] == 1]


def bouncing_chest(clip: Tensor) -> Tensor:
    """A chest that bounces at 4 Hz by 1 cm, with all that it carries."""
    bounced = clip.clone()
    bounced[:, below(CHEST), 1] += 0.01 * sine(clip, 4.0)[:, None]
    return bounced


def damped_chest(clip: Tensor) -> Tensor:
    """Such a chest without its motion of 3 to 6 Hz."""
    bands = parts.split_frequencies(clip[:, CHEST] - clip[:, CANONICAL.parents[CHEST]], 30.0)
    damped = clip.clone()
    damped[:, below(CHEST)] -= bands[2][:, None]
    return damped


def sliding_foot(clip: Tensor) -> Tensor:
    """A left foot that slides aside at 10 cm/s while it is planted, and comes back in its swing."""
    planted = clip[:, CANONICAL.index("leftToes"), 1] < 0.041
    slide = torch.zeros(len(clip), dtype=torch.float64)
    for frame in range(1, len(clip)):
        slide[frame] = slide[frame - 1] + 0.1 / 30 if planted[frame] else 0.6 * slide[frame - 1]
    spoilt = clip.clone()
    spoilt[:, LEFT_FOOT, 0] += slide[:, None]
    return spoilt


def hard_landings(clip: Tensor) -> Tensor:
    """A head that is jolted by 1 cm while a foot lands."""
    landing = kinds.join_foot_phases(kinds.find_foot_phases(clip)) == kinds.BODY_PHASES.index("landing")
    spoilt = clip.clone()
    spoilt[:, HEAD, 1] -= 0.01 * landing.double()
    return spoilt


@pytest.mark.parametrize(
    ("spoil", "joint", "band", "kind"),
    [
        pytest.param(jittery_wrist, "leftHand", "6-10 Hz", "velocities", marks=pytest.mark.slow),
        (lowered_head, "head", "mean pose", "positions"),
    ],
)
def test_a_planted_cause_is_named_first(spoil, joint, band, kind):
    four = replace(SETTINGS, classifier=replace(SETTINGS.classifier, folds=4, steps=300))
    found = explain([spoil(clip) for clip in clean()], clean(), settings=four if kind == "velocities" else SETTINGS)
    assert found.told_apart
    assert (found.joints[0].name, found.bands[0].name, found.inputs[0].name) == (joint, band, kind)
    assert found.cells[0].name == f"{joint}, {band}"
    for first, *others in (found.joints, found.bands, found.cells):
        assert first.named
        assert first.share > 0.7
        assert all(other.share < 0.3 for other in others)
    assert found.joints[0].exchanged is not None
    assert found.joints[0].exchanged < 0.2  # each set's windows pass for the other's
    assert found.joints[1].exchanged is not None
    assert found.joints[1].exchanged > 0.6
    assert (found.moments[0].joint, found.moments[0].band) == (joint, band)
    (walking,) = found.gaits
    assert (walking.gait, walking.joint, walking.band) == ("walk", joint, band)
    # The cause is there all the time, so that no moment of the step is named
    assert max(abs(phase.times - 1) for phase in found.phases if phase.frames and phase.frames > 0.2) < 0.6


@pytest.mark.slow
def test_what_is_missing_is_a_cause():
    bouncing = [bouncing_chest(clip) for clip in clean()]
    found = explain([damped_chest(clip) for clip in bouncing], bouncing)
    assert (found.joints[0].name, found.bands[0].name) == ("chest", "3-6 Hz")
    assert found.cells[0].share > 0.8


@pytest.mark.slow
def test_a_cause_in_landings_alone_names_them():
    found = explain([hard_landings(clip) for clip in clean()], clean())
    assert found.joints[0].name == "head"
    assert found.phases[0].name == "landing"
    assert found.phases[0].named
    assert found.phases[0].share > 0.8
    assert not any(phase.named for phase in found.phases[1:])
    assert {moment.phase for moment in found.moments[:4]} == {"landing"}


@pytest.mark.slow
def test_a_planted_foot_that_slides_is_named_in_its_stance():
    found = explain([sliding_foot(clip) for clip in clean()], clean())
    assert found.told_apart
    assert found.joints[0].name == "leftFoot"
    stance = max(found.feet, key=lambda phase: phase.share)
    assert (stance.name, stance.named) == ("planted", True)
    assert stance.share > 0.6


@pytest.mark.slow
def test_two_halves_of_one_set_have_no_cause():
    found = explain(clean(seed=3), clean())
    assert not found.told_apart
    assert not any(share.named for share in (*found.joints, *found.bands, *found.cells, *found.phases, *found.feet))


def test_parts_add_up_to_the_windows():
    clip = walk(95, turn_rate=0.4).joint_positions()
    cut = parts.cut_parts(clip, WINDOWS)
    assert cut.shape == (7, len(parts.BANDS), 31, 21, 3)
    torch.testing.assert_close(parts.join_parts(cut.sum(dim=1)), realism.cut_windows(clip), atol=1e-4, rtol=0)


def test_travel_is_a_straight_line_and_the_mean_pose_does_not_move():
    cut = parts.cut_parts(walk(95).joint_positions(), WINDOWS)
    travel, still = cut[:, 0], cut[:, 1]
    assert float(travel[:, :, 0].diff(n=2, dim=1).abs().max()) < 1e-5
    assert float(travel[:, -1, 0, 2].min()) > 0.5
    assert float(travel[:, :, 1:].abs().max()) == 0
    assert float(still.diff(dim=1).abs().max()) < 1e-6
    torch.testing.assert_close(
        still,
        cut[:, :3].sum(dim=1).mean(dim=1, keepdim=True).expand_as(still) - travel.mean(dim=1, keepdim=True),
        atol=1e-5,
        rtol=0,
    )


@pytest.mark.parametrize(("hertz", "band"), [(0.6, 0), (2.0, 1), (4.5, 2), (8.0, 3), (12.0, 4)])
def test_a_sine_is_in_its_band(hertz, band):
    """On a long ramp, as a hand's swing is on a walk."""
    time = torch.arange(120, dtype=torch.float64) / 30
    swing = 0.05 * torch.sin(2 * math.pi * hertz * time + 1.0)
    bands = parts.split_frequencies((1.3 * time + swing)[:, None], 30.0)[:, :, 0]
    torch.testing.assert_close(bands.sum(dim=0), 1.3 * time + swing)
    bands[0] -= 1.3 * time
    power = bands[:, 20:-20].square().mean(dim=1)
    assert float(power[band] / power.sum()) > 0.97


def test_evidence_adds_up_to_the_logits_change():
    """Of a network that bends; and velocities count where their joint moves."""
    clips = clean()
    made, mocap = (parts.cut_parts(clip, WINDOWS) for clip in clips[:2])
    bent = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(30 * 126, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))
    torch.manual_seed(0)
    for parameter in bent.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    network = torch.nn.Sequential(bent, torch.nn.Flatten(0))
    found = paths.gather_evidence(network, made, mocap, steps=64)
    ends = [network(parts.join_parts(each.sum(dim=1))).detach() for each in (made, mocap)]
    for sums in (found.cells.sum(dim=(1, 2)), found.frames.sum(dim=(1, 2)), found.inputs.sum(dim=1)):
        torch.testing.assert_close(sums, ends[0] - ends[1], atol=1e-4, rtol=1e-3)


def test_an_exchange_is_of_the_group_alone():
    """A network that sees one joint's height alone answers to its exchange, its band's and that of positions."""
    made, mocap = (parts.cut_parts(clip, WINDOWS) for clip in clean()[:2])
    raised = made.clone()
    raised[:, 1, :, HEAD, 1] += 1.0

    class Height(torch.nn.Module):
        def forward(self, windows):
            return windows[..., 3 * HEAD + 1].mean(dim=1)

    height = Height()
    logits = paths.exchange_groups(height, raised, made)
    groups = [*parts.BANDS, *parts.JOINTS, *paths.INPUTS]
    before = height(parts.join_parts(raised.sum(dim=1)))
    fell = {name for name, fall in zip(groups, (before - logits.T).mean(dim=1).tolist(), strict=True) if fall > 0.5}
    assert fell == {"mean pose", "head", "positions"}
    assert logits.shape == (len(mocap), len(groups))


@pytest.mark.parametrize(
    ("clip", "gait"),
    [
        (walk(61, cadence=0.4), "slow walk"),
        (walk(61), "walk"),
        (walk(61, cadence=1.7), "run"),
        (walk(61, turn_rate=0.8), "turning"),
        (walk_through(torch.zeros(61, 2)), "standing"),
        (walk_through(torch.linspace(0, -2, 61)[:, None] * torch.tensor([0.0, 1.0])), "backwards"),
        (walk_through(torch.linspace(0, 2, 61)[:, None] * torch.tensor([1.0, 0.0])), "sideways"),
    ],
)
def test_gaits_of_a_second(clip, gait):
    found = kinds.classify_gaits(clip.joint_positions(), WINDOWS)
    assert {kinds.GAITS[each] for each in found.tolist()} == {gait}


def test_phases_of_feet_follow_contacts():
    clip = clean()[0]
    phases = kinds.find_foot_phases(clip)[:, 0]
    low = clip[:, CANONICAL.index("leftToes"), 1] < 0.041
    lands = int((low[1:] & ~low[:-1]).nonzero()[0]) + 1
    told = [kinds.FOOT_PHASES[phase] for phase in phases[lands - 8 : lands + 8].tolist()]
    assert told.index("landing") in range(5, 10)
    assert (told[0], told[-1]) == ("swing", "planted")
    assert told.count("landing") == 5


def test_the_body_lands_with_either_foot():
    feet = torch.tensor([[0, 0], [0, 2], [2, 2], [0, 1], [3, 1]])
    told = [kinds.BODY_PHASES[phase] for phase in kinds.join_foot_phases(feet).tolist()]
    assert told == ["on both feet", "on one foot", "in flight", "lift", "landing"]


def test_what_networks_of_groups_are_given(monkeypatch: pytest.MonkeyPatch):
    """Positions are those of whole windows, and those of legs do not tell where the hips are."""

    def list_given(clips: list[Tensor]) -> dict[str, Tensor]:
        given: list[Tensor] = []

        def keep(made: list[Tensor], mocap: list[Tensor], **_: object) -> list[object]:
            given.append(torch.cat(made))
            return []

        monkeypatch.setattr(alone, "judge_folds", keep)
        monkeypatch.setattr(alone, "average_verdicts", lambda _: SimpleNamespace(accuracy=0.5))
        found = alone.measure_alone(
            clips, clips, windows=WINDOWS, classifier=SETTINGS.classifier, seed=1, groups=("positions", "legs")
        )
        return dict(zip(found, given, strict=True))

    clips = list(clean()[:2])
    lifted = [clip + torch.linspace(0, 0.1, len(clip))[:, None, None] * torch.tensor([0.0, 1.0, 0.0]) for clip in clips]
    still, moved = list_given(clips), list_given(lifted)
    whole = torch.cat([cut_windows(clip, WINDOWS) for clip in clips])
    positions = whole[..., : whole.shape[-1] // 2]
    torch.testing.assert_close(still["positions"], positions, atol=1e-4, rtol=0, check_dtype=False)
    assert float((moved["positions"] - still["positions"]).abs().max()) > 0.05
    torch.testing.assert_close(moved["legs"], still["legs"], atol=1e-3, rtol=0)


@pytest.mark.slow
def test_what_a_group_tells_alone():
    """The joint, the band and positions tell a lowered head alone, and others nothing."""
    made = [lowered_head(clip) for clip in clean()]
    found = alone.measure_alone(
        made, clean(), windows=WINDOWS, classifier=replace(SETTINGS.classifier, steps=60), seed=1
    )
    assert set(found) == {*parts.BANDS, *parts.JOINTS, *paths.INPUTS, *alone.REGIONS}
    assert min(found["head"], found["mean pose"], found["positions"], found["trunk and head"]) > 0.9
    assert max(found["leftHand"], found["3-6 Hz"], found["hips"], found["legs"], found["arms"]) < 0.7


@pytest.mark.slow
def test_feet_that_slide_are_told_over_the_ground_and_not_from_the_hips():
    """A body that is shaken as a whole: its pose is as it was."""
    shaken = [clip + 0.02 * torch.randn(len(clip), 1, 3, generator=generator(k)) for k, clip in enumerate(clean())]
    settings = replace(SETTINGS.classifier, steps=60)
    found = alone.measure_alone(
        shaken, clean(), windows=WINDOWS, classifier=settings, seed=1, groups=alone.REGIONS, paired=True
    )
    assert list(found) == ["feet over the ground", "legs", "trunk and head", "arms"]
    assert found["feet over the ground"] > 0.9
    assert max(found["legs"], found["trunk and head"], found["arms"]) < 0.7
