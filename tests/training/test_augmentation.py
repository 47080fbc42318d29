"""Windows and copies of clips, mirrored, at other tempos and in unfamiliar poses: they are motions."""

import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import corpus, generator, walk, walks
from performers import Performer
from scipy.spatial.transform import Rotation

from mapctl import rotations
from mapctl.contacts import ContactSettings
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.inbetweening.partial_motion import KnownParts
from mapctl.motion import Motion
from mapctl.pose import BodyPose, decode
from mapctl.recording.masks import MissingMask
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.training.augment import add_copies, copy_clip
from priors.training.data import Corpus
from priors.training.recipes.infiller import show_known
from priors.training.windows import PoseVariation, PoseWindows, vary_features


def decoded(features):
    return decode(features.double(), GroundPose(torch.zeros(2).double(), torch.zeros(()).double()))


def about_y(angle):
    """Rotations by scipy."""
    return Rotation.from_rotvec(angle.double()[:, None].numpy() * [0.0, 1.0, 0.0])


def without_heading(positions, facing):
    """Places (frames, joints, 3) seen along the headings."""
    return torch.from_numpy(about_y(-facing).as_matrix()[:, None] @ positions.double().numpy()[..., None])[..., 0]


def seen_from_the_root(motion):
    """Joint positions over the hips' ground point, the heading turned away; by scipy."""
    forward = Rotation.from_quat(motion.local_quat_xyzw[:, 0].numpy()).as_matrix()[:, :, 2]
    facing = 2 * torch.atan2(motion.local_quat_xyzw[:, 0, 1], motion.local_quat_xyzw[:, 0, 3])
    assert (torch.from_numpy(forward)[:, 2] * torch.cos(facing) > 0).all()  # upright, so that facing is near enough
    positions = motion.joint_positions() - motion.root_position[:, None] * torch.tensor([1.0, 0.0, 1.0])
    return without_heading(positions, facing)


def test_a_window_is_the_motion_from_that_frame_on():
    data = corpus(3, 60)
    found = PoseWindows(data).at(torch.tensor([1, 2]), torch.tensor([10, 36]), 24, torch.ones(2))
    positions = found.world_poses()[0]
    for row, (clip, first) in enumerate(((1, 10), (2, 36))):
        features = data.features[60 * clip : 60 * (clip + 1)]
        wanted = decoded(features).joint_positions()[first : first + 24]
        assert (positions[row].double() - wanted).norm(dim=-1).max() < 1e-4
        assert torch.equal(found.contacts[row], LAYOUT.pick(features, "contacts")[first : first + 24])
        facing = torch.from_numpy(about_y(found.heading[row]).apply([0.0, 0.0, 1.0]))
        hips = torch.from_numpy(Rotation.from_quat(decoded(features).local_quat_xyzw[:, 0].numpy()).as_matrix())
        assert torch.cosine_similarity(facing[:, ::2], hips[first : first + 24, ::2, 2], dim=1).min() > 0.99


def test_a_mirrored_window_is_the_window_in_a_mirror():
    plain = PoseWindows(corpus(3, 60)).at(torch.tensor([2]), torch.tensor([20]), 30, torch.ones(1))
    positions = plain.mirrored().world_poses()[0]
    # The walk itself in a mirror, but for where it starts and faces.
    wanted = seen_from_the_root(walks(3, 60)[2].mirror())[20:50]
    local = positions[0] - positions[0, :, :1] * torch.tensor([1.0, 0.0, 1.0])
    assert (without_heading(local, plain.mirrored().heading[0]) - wanted).norm(dim=-1).max() < 1e-4


def test_the_guess_in_a_gap_is_the_one_that_filling_starts_from():
    """From the rotations of a batch, and of a motion on its rig, bent by the velocities beside the gap, too."""
    shown = PoseWindows(corpus(3, 60)).at(torch.tensor([1]), torch.tensor([3]), 40, torch.ones(1))
    known = torch.ones(1, 40, dtype=torch.bool)
    known[:, 10:25] = False
    quats = rotations.from_matrix(shown.local_matrices()[0].double())
    motion = Motion(CANONICAL, Fraction(30), shown.root_position[0].double(), quats)
    gone = ~known[0]
    lost = MissingMask(gone[:, None].expand(-1, CANONICAL.num_joints), gone)
    wanted = interpolate_missing(motion, lost).joint_positions()
    image, _ = show_known(shown, replace(shown, known=KnownParts.whole(known)))
    torch.testing.assert_close(image.to_world(image.positions)[0].double(), wanted, atol=0.05, rtol=0)


pytestmark = pytest.mark.usefixtures("small_judgements")
FACTORS = [(1.15, 1.0), (0.85, 1.0), (1.0, 1.1), (1.0, 0.9), (1.12, 1.08), (0.9, 0.93)]


def corpus_of(*motions):
    clips = [encode(motion)[0].float() for motion in motions]
    return Corpus(tuple(f"{k}/walk_{k}.bvh" for k in range(len(clips))), tuple(map(len, clips)), torch.cat(clips))


@pytest.fixture(scope="module")
def clips():
    """A walk whose planted toes do not move at all, one that turns, and one who stands."""
    turning = walk(90, turn_rate=0.6)
    return corpus_of(Performer(upright=0.88).walks(120), turning, Performer().stands(60))


@pytest.fixture(scope="module")
def windows(clips):
    return PoseWindows(clips)


def decode_feet(features):
    """World positions of joints on canonical bones, planted toes, and the features."""
    positions = BodyPose.of_features(features.double(), GroundPose.origin(torch.float64)).joints_world()
    return positions, positions[:, list(TOE_JOINTS)], features[:, LAYOUT.slices["contacts"]] > 0.5


def slide(toes, planted):
    """Speeds of planted toes over the ground, m/s."""
    return (torch.diff(toes, dim=0)[..., ::2].norm(dim=-1) * PRIOR_FPS)[planted[1:] & planted[:-1]]


@pytest.mark.parametrize(("tempo", "strides"), FACTORS)
def test_feet_that_stand_stand_in_a_copy(clips, windows, tempo, strides):
    before, after = decode_feet(clips.clips()[0]), decode_feet(copy_clip(windows, 0, tempo=tempo, strides=strides))
    for _, toes, planted in (before, after):
        assert slide(toes, planted).quantile(0.9) < 0.01
        # The first frame and the last of a contact are those of a toe that comes and goes.
        assert slide(toes, planted).max() < 0.35 * tempo
    heights = [toes[..., 1][planted] for _, toes, planted in (before, after)]
    assert float((heights[1].median() - heights[0].median()).abs()) < 1e-3
    assert after[1][..., 1].min() > before[1][..., 1].min() - 2e-3


@pytest.mark.parametrize(("tempo", "strides"), FACTORS)
def test_ways_and_turns_are_in_proportion(clips, windows, tempo, strides):
    for number, clip in enumerate(clips.clips()):
        copy = copy_clip(windows, number, tempo=tempo, strides=strides)
        assert len(copy) == int((len(clip) - 1) / tempo) + 1
        turns = [float(LAYOUT.pick(features, "heading_change")[1:].sum()) for features in (clip, copy)]
        # The last frame of a copy may lie before the last of its clip by less than a step.
        assert turns[1] == pytest.approx(turns[0], abs=0.6 / PRIOR_FPS * tempo + 1e-3)
        ways = [decode_feet(features)[0][:, 0, ::2] for features in (clip, copy)]
        far = [float((way[-1] - way[0]).norm()) for way in ways]
        assert far[1] == pytest.approx(strides * far[0], abs=0.05)
        speeds = [LAYOUT.pick(f, "root_displacement_heading").norm(dim=-1).mean() for f in (clip, copy)]
        assert float(speeds[1]) == pytest.approx(float(tempo * strides * speeds[0]), abs=3e-4)


@pytest.mark.slow
def test_copies_come_after_their_clips_with_their_names_and_the_seed_draws_them(clips):
    one, again, other = (add_copies(clips, 2, generator(seed)) for seed in (1, 1, 2))
    assert one.names == clips.names * 3
    assert one.lengths[:3] == clips.lengths
    assert torch.equal(one.features[: len(clips.features)], clips.features)
    assert torch.equal(one.features, again.features)
    assert one.lengths != other.lengths
    assert one.lengths[3:6] != one.lengths[6:9]
    least, most = (clips.lengths[0] / factor for factor in (1.15, 0.85))
    assert all(least - 1 <= length <= most + 1 for length in (one.lengths[3], one.lengths[6]))
    spread = [one.features[:, LAYOUT.slices["root_height"]], clips.features]
    assert all(map(lambda part: bool(torch.isfinite(part).all()), spread))


TURNED = PoseVariation(share=1.0, drift=0.0, tilted=0.0)
TILTED = PoseVariation(share=0.0, tilted=1.0)


def pose_windows():
    return corpus(2, 40).features.unfold(0, 30, 5).transpose(1, 2).contiguous()


def poses(features):
    return BodyPose.of_features(features, GroundPose.origin())


def speeds(features):
    """Angle from frame to frame of each joint but the hips, radians."""
    quats = rotations.from_rotation_vector(poses(features).joint_rotvec)
    return rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:, :-1]), quats[:, 1:])).norm(dim=-1)


def test_joints_turned_by_constants_turn_as_fast_and_the_hips_move_as_before():
    given = pose_windows()
    varied = vary_features(given, TURNED, generator())
    torch.testing.assert_close(speeds(varied), speeds(given), atol=1e-3, rtol=0)
    torch.testing.assert_close(poses(varied).root_position, poses(given).root_position, atol=1e-4, rtol=0)
    assert float((poses(varied).joint_rotvec - poses(given).joint_rotvec).norm(dim=-1).mean()) > math.radians(5)


def test_tilted_bodies_move_rigidly():
    """All joints as far from each other as before, and many hips lower and far from upright."""
    given = pose_windows()
    varied = vary_features(given, TILTED, generator())
    one, other = (poses(each).joints_world() for each in (given, varied))
    torch.testing.assert_close(torch.cdist(one, one), torch.cdist(other, other), atol=2e-3, rtol=0)
    up = rotations.rotate(poses(varied).local_quat_xyzw[:, :, 0], torch.tensor([0.0, 1.0, 0.0]))[..., 1]
    assert float(up.min()) < 0.6
    lowered = (one - other)[..., 0, 1]
    assert float(lowered.max()) > 0.2
    assert float(lowered.min()) > -1e-4


@pytest.mark.parametrize("variation", [TURNED, TILTED, PoseVariation()])
def test_contacts_are_of_toes_that_were_planted_and_still_do_not_travel(variation):
    given = pose_windows()
    varied = vary_features(given, variation, generator())
    before, after = (LAYOUT.pick(each, "contacts") for each in (given, varied))
    assert bool((after <= before).all())
    toes = poses(varied).joints_world()[..., list(TOE_JOINTS), ::2]
    speed = torch.diff(toes, dim=1).norm(dim=-1) * PRIOR_FPS
    assert torch.equal(after[:, 1:] > 0, (before[:, 1:] > 0) & (speed < ContactSettings.slow))
