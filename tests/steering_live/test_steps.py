"""Planned steps and stands: where they lead, what feet do meanwhile, and that steering obeys commands by them."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator
from tiny_prior import save_tiny_prior

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from controllers.steering.stand import Stand, find_stand
from controllers.steering.steps import PlannedSteps, needs_steps, plan_steps
from mapctl import rotations
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.intent.steering import Command, CommandTrack, SteeringLimits
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


def play(features):
    return decode(features.double(), GroundPose(HERE.position_xz.double(), HERE.heading.double()))


def walk_before(stand, speed):
    """Joints of the last frames of a body whose hips went ahead over its feet, m/s."""
    step = torch.tensor([math.sin(AHEAD), 0.0, math.cos(AHEAD)]) * speed / PRIOR_FPS
    joints, feet = (
        stand.joint_positions() + torch.arange(-5, 1)[:, None, None] * step,
        CANONICAL.indices((*TOES, *FEET)),
    )
    joints[:, feet] = stand.joint_positions()[:, feet]
    return joints


def find_worst_feet(motion):
    positions = motion.joint_positions()
    assert float(positions[:, CANONICAL.indices(TOES), 1].min()) > TOE_REST_HEIGHT - 0.005
    return measure_worst(positions, 0, CANONICAL.indices(TOES), CANONICAL.indices(FEET), PRIOR_FPS)


@pytest.mark.parametrize("moving", [0.0, 0.8])
@pytest.mark.parametrize(
    ("speed", "travel", "turn"),
    [(0.7, math.pi, 0.0), (0.5, math.pi / 2, 0.0), (0.8, -math.pi / 2, 0.0), (0.6, 2.2, 0.5), (1.1, 0.8, 0.0)],
)
def test_a_body_travels_as_commanded_on_feet_that_stand(stand, speed, travel, turn, moving):
    """From a stand, and from walking ahead; angles are from the facing at the start, radians."""
    command = Command(speed, AHEAD + travel, AHEAD + turn)
    steps = plan_steps(stand, walk_before(stand, moving), stand, command, SteeringLimits())
    assert steps is not None
    motion = play(steps.window(240))
    went = (motion.root_position[-1] - motion.root_position[-1 - steps.cycle])[::2] * PRIOR_FPS / steps.cycle
    wanted = speed * torch.tensor([math.sin(command.heading), math.cos(command.heading)], dtype=went.dtype)
    assert float((went - wanted).norm()) < 0.01
    assert float(BodyPose.of_motion(motion).heading[-1]) == pytest.approx(command.hips_heading, abs=0.01)
    travelled = torch.tensor([target.velocity for target in steps.targets_of(240)]).sum(dim=0) / PRIOR_FPS
    assert float((motion.root_position[-1, ::2] - HERE.position_xz - travelled).norm()) < 0.04
    whole, parts = steps.window(240), [steps.after(at).window(3) for at in range(0, 240, 3)]
    assert torch.equal(torch.cat(parts), whole)
    worst = find_worst_feet(motion)
    assert worst["glide_cm"] < 1
    assert worst["slide_max_cm"] < 1.5
    assert worst["unsupported_max_s"] == 0
    toes = motion.joint_positions()[:, CANONICAL.indices(TOES)]
    apart = rotations.rotate_about_y(toes[:, 0] - toes[:, 1], -BodyPose.of_motion(motion).heading)
    assert float(apart.norm(dim=-1).max()) < 0.85
    assert float(apart[:, 0].min()) > -0.02  # feet do not cross


def test_arms_swing_against_legs_and_a_foot_in_the_air_goes_on(stand):
    hanging = stand.local_quat_xyzw.clone()
    for name, angle in (("leftUpperArm", -1.4), ("rightUpperArm", 1.4)):
        hanging[:, CANONICAL.index(name)] = rotations.from_rotation_vector(torch.tensor([0.0, 0.0, angle]).double())
    stand = replace(stand, local_quat_xyzw=hanging)
    joints = stand.joint_positions().expand(4, -1, 3).clone()
    right = CANONICAL.index("rightToes")
    joints[-2, right] -= torch.tensor([math.sin(AHEAD), 0.0, math.cos(AHEAD)]) * 1.5 / PRIOR_FPS
    steps = plan_steps(stand, joints, stand, Command(0.8, AHEAD + math.pi, AHEAD), SteeringLimits())
    assert steps is not None
    motion = play(steps.window(240))
    heading = BodyPose.of_motion(motion).heading
    ahead = rotations.rotate_about_y(motion.joint_positions() - motion.root_position[:, None], -heading[:, None])[
        ..., 2
    ]
    feet, hands = (
        ahead[60:, CANONICAL.index(f"left{end}")] - ahead[60:, CANONICAL.index(f"right{end}")]
        for end in ("Foot", "Hand")
    )
    assert float(torch.corrcoef(torch.stack([feet, hands]))[0, 1]) < -0.9
    assert 0.1 < float(hands.abs().max()) < 0.6
    assert float(ahead[1, right] - ahead[0, right]) > 0.004


@pytest.mark.parametrize(
    ("turn", "moving", "frames"), [(2.5, 0.0, 60), (-0.6, 0.0, 40), (0.0, 1.1, 40), (1.0, 0.8, 50)]
)
def test_a_body_turns_or_stops_into_a_balanced_stand(stand, turn, moving, frames):
    steps = plan_steps(stand, walk_before(stand, moving), stand, Command(0.0, AHEAD + turn), SteeringLimits())
    assert steps is not None
    assert len(steps.features) < frames
    motion = play(steps.window(len(steps.features) + 5))
    went = moving**2 / 2 / SteeringLimits.braking
    assert float((motion.root_position[-1, ::2] - HERE.position_xz).norm()) == pytest.approx(went, abs=0.03)
    assert torch.equal(motion.root_position[-5], motion.root_position[-1])
    assert float(BodyPose.of_motion(motion).heading[-1]) == pytest.approx(AHEAD + turn, abs=0.01)
    worst = find_worst_feet(motion)
    assert worst["glide_cm"] < 1
    assert worst["slide_max_cm"] < 1.5
    assert worst["unsupported_max_s"] == 0
    toes = motion.joint_positions()[-1, CANONICAL.indices(TOES)] - motion.root_position[-1]
    wanted = stand.joint_positions()[0, CANONICAL.indices(TOES)] - stand.root_position[0]
    assert (
        float((rotations.rotate_about_y(wanted, torch.tensor(turn).double()) - toes)[:, ::2].norm(dim=-1).max()) < 0.06
    )
    assert steps.after(len(steps.features)).ended
    assert not steps.after(1).ended


def test_travel_is_no_faster_than_feet_can_step(stand):
    command = Command(4.0, AHEAD + math.pi / 2, AHEAD)
    steps = plan_steps(stand, walk_before(stand, 0.0), stand, command, SteeringLimits())
    assert steps is not None
    assert 1.0 < steps.targets[-1].speed < 2.0
    assert steps.obey(command, AHEAD)
    toes = play(steps.window(120)).joint_positions()[:, CANONICAL.indices(TOES)]
    assert float((toes[:, 0] - toes[:, 1]).norm(dim=-1).max()) < 0.85
    assert float(torch.diff(toes[:, :, ::2], dim=0).norm(dim=-1).max()) * PRIOR_FPS < 8


def test_a_body_that_stands_as_it_is_to_takes_no_step(stand):
    assert plan_steps(stand, walk_before(stand, 0.0), stand, Command(0.0, AHEAD), SteeringLimits()) is None


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


@pytest.mark.parametrize(("heading", "wanted"), [(0.3, False), (1.0, True), (math.pi, True), (2 * math.pi, False)])
def test_a_walk_starts_by_steps_until_the_body_is_headed_for_it(heading, wanted):
    walk = Command(1.0, heading)
    assert needs_steps(walk, 0.0, starts=True) == wanted
    assert not needs_steps(walk, 0.0)
    planned = PlannedSteps(walk, torch.zeros(3, 68), [])
    assert planned.obey(walk, heading + 0.3)
    assert not planned.obey(walk, heading + 0.1)


@pytest.mark.parametrize(
    ("command", "obeyed"),
    [
        (Command(0.6, 1.5, 0.0), True),
        (Command(0.65, 1.6, -0.1), True),
        (Command(0.0, 1.5, 0.0), False),
        (Command(0.6, -1.5, 0.0), False),
        (Command(0.6, 1.5), False),
        (Command(1.0, 1.5, 0.0), False),
    ],
)
def test_steps_obey_commands_like_their_own(command, obeyed):
    planned = PlannedSteps(Command(0.6, 1.5, 0.0), torch.zeros(3, 68), [])
    assert planned.obey(command, 0.0) == obeyed
    assert not planned.after(3).obey(command, 0.0)
    assert replace(planned, cycle=2).after(3).obey(command, 0.0) == obeyed


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
