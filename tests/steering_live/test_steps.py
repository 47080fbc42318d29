"""Planned steps and stands: where they lead, what feet do meanwhile, and that steering obeys commands by them."""

import math

import pytest
import torch
from helpers import generator
from tiny_prior import save_tiny_prior

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from controllers.steering.steps import PlannedSteps, Stand, find_stand, needs_steps, plan_steps
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.intent.steering import Command, CommandTrack, SteeringLimits, SteeringTarget
from mapctl.metrics.body import measure_worst
from mapctl.metrics.travel import measure_commands
from mapctl.pose import BodyPose, decode
from mapctl.skeleton import CANONICAL, FEET, TOE_REST_HEIGHT, TOES

HERE = GroundPose(torch.tensor([1.0, -2.0]), torch.tensor(0.7))
AHEAD = 0.7


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    """The stand of the mean pose of walks."""
    prior = priors.load(str(save_tiny_prior(tmp_path_factory.mktemp("prior") / "p.safetensors")))
    return find_stand(prior.feature_mean, HERE, CANONICAL, TOE_REST_HEIGHT)


def test_a_stand_has_both_feet_flat_beside_each_other_under_the_hips(stand):
    toes = stand.joint_positions()[0, CANONICAL.indices(TOES)]
    assert toes[:, 1].tolist() == pytest.approx([TOE_REST_HEIGHT] * 2, abs=1e-6)
    ahead = torch.tensor([math.sin(AHEAD), math.cos(AHEAD)], dtype=torch.float64)
    assert float(((toes[0] - toes[1])[::2] @ ahead).abs()) < 1e-6
    assert float((toes.mean(dim=0) - stand.root_position[0])[::2].norm()) < 0.2
    turned = stand.joint_rotations()[0, CANONICAL.indices(FEET)]
    assert torch.allclose(turned[:, [0, 2]], torch.zeros(2, 2, dtype=turned.dtype), atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "travel", "turn"),
    [
        (0.7, math.pi, 0.0),
        (0.5, math.pi / 2, 0.0),
        (0.5, -math.pi / 2, 0.0),
        (0.6, 2.2, 0.5),
        (0.0, 0.0, 2.5),
        (0.0, 0.0, -0.6),
    ],
)
def test_steps_lead_where_the_targets_do_on_feet_that_stand(stand, speed, travel, turn):
    """Angles are from the facing at the start, radians."""
    command = Command(speed, AHEAD + travel, AHEAD + turn)
    start = SteeringTarget(0.0, command.heading, AHEAD)
    targets = start.ahead(command, SteeringLimits(), frames=90, fps=PRIOR_FPS)
    steps = plan_steps(stand, stand, command, targets if speed else targets[-1:])
    assert steps is not None
    motion = decode(steps.features.double(), GroundPose(HERE.position_xz.double(), HERE.heading.double()))
    went = torch.tensor([target.velocity for target in targets]).sum(dim=0) / PRIOR_FPS
    assert float((motion.root_position[-1, ::2] - HERE.position_xz - went).norm()) < 0.01
    assert float(BodyPose.of_motion(motion).heading[-1]) == pytest.approx(targets[-1].facing, abs=0.01)
    positions, feet = motion.joint_positions(), (CANONICAL.indices(TOES), CANONICAL.indices(FEET))
    worst = measure_worst(positions, 0, *feet, PRIOR_FPS)
    assert worst["glide_cm"] < 1
    assert worst["slide_max_cm"] < 4
    assert worst["unsupported_max_s"] == 0
    assert float(positions[:, CANONICAL.indices(TOES), 1].min()) > TOE_REST_HEIGHT - 0.005


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        (Command(1.0, 0.0), False),
        (Command(1.0, 0.3, 0.0), False),
        (Command(1.0, 1.0, 0.0), True),
        (Command(1.0, math.pi, 0.0), True),
        (Command(1.0, math.pi), False),
        (Command(1.0, 0.0, turning=1.0), False),
        (Command(0.0, 0.05), False),
        (Command(0.0, 1.0), True),
        (Command(0.0, 0.0, -1.0), True),
    ],
)
def test_what_is_no_walk_needs_steps(command, wanted):
    assert needs_steps(command, 0.0) == wanted


@pytest.mark.parametrize(
    ("command", "obeyed"),
    [
        (Command(0.6, 1.5, 0.0), True),
        (Command(0.7, 1.6, -0.1), True),
        (Command(0.0, 1.5, 0.0), False),
        (Command(0.6, -1.5, 0.0), False),
        (Command(0.6, 1.5), False),
        (Command(1.0, 1.5, 0.0), False),
    ],
)
def test_steps_obey_commands_like_their_own(command, obeyed):
    assert PlannedSteps(Command(0.6, 1.5, 0.0), torch.zeros(3, 68)).obey(command) == obeyed
    assert not PlannedSteps(Command(0.6, 1.5, 0.0), torch.zeros(0, 68)).obey(command)


def test_a_stand_sways_without_creeping_trembling_or_repeating(stand):
    """Its frames are the same however many are asked for at once."""
    whole, at = [], Stand(stand, stand)
    for _ in range(3 * 60 * 10):
        at, features = at.advance(3)
        whole.append(features)
    start = GroundPose(HERE.position_xz.double(), HERE.heading.double())
    positions = decode(torch.cat(whole).double(), start).joint_positions()
    assert torch.allclose(torch.cat(whole)[:300], Stand(stand, stand).advance(300)[1], atol=1e-5)
    hips, toes, head = (
        positions[:, 0, ::2],
        positions[:, CANONICAL.indices(TOES)],
        positions[:, CANONICAL.index("head")],
    )
    assert float((toes - toes[0]).norm(dim=-1).max()) < 0.002
    half_minutes = hips[: 900 * (len(hips) // 900)].unflatten(0, (-1, 900)).mean(dim=1)
    assert float((half_minutes - half_minutes[0]).norm(dim=-1).max()) < 0.01
    assert 0.002 < float((hips - hips.mean(dim=0)).norm(dim=-1).max()) < 0.03
    assert float(torch.diff(head, n=2, dim=0).norm(dim=-1).max()) * PRIOR_FPS**2 < 0.5
    minute = head[900:2700]
    shifts = [float((head[900 + by : 2700 + by] - minute).norm(dim=-1).max()) for by in range(150, 2400, 50)]
    assert min(shifts) > 0.002


@pytest.mark.slow
@pytest.mark.parametrize("name", ["locomotion-live", "free/locomotion"])
def test_bundled_densities_obey_commands_that_are_no_walk(name):
    commands = [
        *(Command(1.1, 0.0), Command(0.0, 0.0), Command(0.7, math.pi, 0.0), Command(0.5, math.pi / 2, 0.0)),
        *(Command(0.0, 0.0), Command(0.0, math.pi / 2), Command(0.0, -0.6), Command(0.7, 0.3, -0.6)),
    ]
    times = [4.0 * number for number in range(len(commands))]
    track = CommandTrack((*times, times[-1] + 4.0), (*commands, commands[-1]))
    state, first = steer.begin(priors.load(name), commands[0], generator=generator(0))
    recorder = Recorder()
    recorder.show(first, 0.0)
    drive(state, track.at, [recorder.show], frames=round(30 * track.times[-1]))
    rows = measure_commands(recorder.motion(), track)[2:-1]
    reached = [row["reached_s"] for row in rows]
    assert all(seconds is not None and seconds <= 2.0 for seconds in reached), reached
    assert max(abs(row["steady_facing_error_deg"] or 0.0) for row in rows) < 10
