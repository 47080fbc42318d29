"""Motion on another body: it stands on its floor, planted feet stay, nothing jumps; what changed is reported."""

import math
from dataclasses import replace

import pytest
import torch
from hand_poses import arms_down
from helpers import bandai_skeleton, quat_xyzw, walk
from performers import FEET, HIPJOINTS, KNEES, TOES, Performer
from rig_maker import Make, make, names_of
from scipy.spatial.transform import Rotation

import mapctl
from mapctl import contacts, retarget, rotations
from mapctl.commands.shared import inputs
from mapctl.motion import Motion
from mapctl.retarget.carry import GroundMode, RiggedCharacter, find_ground, retarget_canonical, retarget_motion
from mapctl.retarget.character import LEGS, limb_extension
from mapctl.retarget.legs import fit_hips
from mapctl.skeleton import CANONICAL, leg_length

USUAL = Performer()
PEOPLE = {
    "tall": Performer(size=1.25, toe_height=0.02),
    "short legs": Performer(leg=0.85, toe_height=0.05),
    "long flat foot": Performer(size=1.1, foot=(-0.06, 0.15), toe_height=0.015),
    "drooping T-pose": Performer(size=0.9, droop_deg=20, foot=(-0.05, 0.12), toe_height=0.03),
    "below the floor": Performer(size=1.03, toe_height=-0.03),
}
PAIRS = [("usual", "tall"), ("short legs", "usual"), ("usual", "long flat foot"), ("drooping T-pose", "usual")]
PAIRS += [("usual", "below the floor"), ("tall", "drooping T-pose")]


FLAT = Performer(leg=1.1, foot=(-0.06, 0.15), toe_height=0.02)


def performer(name: str) -> Performer:
    return USUAL if name == "usual" else PEOPLE[name]


def low_toes(motion: Motion) -> torch.Tensor:
    return motion.joint_positions()[:, TOES, 1].quantile(0.05, dim=0)


def planted_speed(motion: Motion) -> float:
    """Speeds of toes over the ground, m/s."""
    toes = motion.joint_positions()[:, TOES]
    stands = contacts.detect_contacts(toes, motion.fps)[1:]
    return float((toes.diff(dim=0)[..., ::2].norm(dim=-1) * float(motion.fps))[stands].mean())


def foot_pitch_deg(motion: Motion) -> torch.Tensor:
    """Slope of the bones from ankles to toe joints, while these stand and the ankles are at their lowest."""
    ankles, toes = motion.joint_positions()[:, FEET], motion.joint_positions()[:, TOES]
    way = toes - ankles
    flat = contacts.detect_contacts(toes, motion.fps) & (ankles[..., 1] < ankles[..., 1].quantile(0.1, dim=0) + 0.005)
    pitch = torch.rad2deg(torch.asin(way[..., 1] / way.norm(dim=-1)))
    return torch.stack([pitch[flat[:, k], k].median() for k in range(2)])


@pytest.mark.parametrize(("source", "body", "fps"), [(*pair, 30) for pair in PAIRS] + [(*PAIRS[2], 120)])
def test_a_retargeted_walker_stands_as_in_the_source(source, body, fps):
    clip, own = performer(source).walks(90 * fps // 30, fps), performer(body).walks()
    done = retarget_motion(clip, RiggedCharacter.of(own)[1])
    assert done.changes.notes == ()
    torch.testing.assert_close(low_toes(done.motion), low_toes(own), atol=0.008, rtol=0)
    torch.testing.assert_close(foot_pitch_deg(done.motion), foot_pitch_deg(own), atol=1.5, rtol=0)
    assert planted_speed(done.motion) < 1.15 * planted_speed(clip) + 0.01
    scale = leg_length(own.skeleton) / leg_length(clip.skeleton)
    way = scale * (clip.root_position[-1] - clip.root_position[0])[::2]
    torch.testing.assert_close(
        (done.motion.root_position[-1] - done.motion.root_position[0])[::2], way, atol=0.02, rtol=0
    )


@pytest.mark.parametrize(("source", "body"), PAIRS)
def test_nothing_moves_or_turns_faster_than_it_did(source, body):
    """The worst frame of every joint of the legs, in scale."""
    clip, own = performer(source).walks(), performer(body).walks()
    done = retarget_motion(clip, RiggedCharacter.of(own)[1]).motion
    scale = leg_length(own.skeleton) / leg_length(clip.skeleton)
    legs = [j for j, name in enumerate(CANONICAL.names) if name.endswith(("hips", "Leg", "Foot", "Toes"))]
    for order, most in ((1, 1.15), (2, 1.35)):
        before, after = (m.joint_positions()[:, legs].diff(n=order, dim=0).norm(dim=-1).amax(0) for m in (clip, done))
        assert (after <= most * scale * before.clamp_min(float(before.median()))).all()


def test_a_clip_of_the_bodys_own_skeleton_stays_to_the_bit():
    clip, body = PEOPLE["drooping T-pose"].walks(), PEOPLE["drooping T-pose"].body()
    lifted = replace(clip, root_position=clip.root_position + 0.5)
    done = retarget_motion(lifted, body).motion
    assert torch.equal(done.root_position, lifted.root_position)
    torch.testing.assert_close(done.local_quat_xyzw, lifted.local_quat_xyzw, atol=1e-12, rtol=0)


@pytest.mark.parametrize(("source", "body"), PAIRS)
def test_there_and_back_is_where_one_was(source, body):
    """Every joint of a walk within 1 cm on the mean of its frames, and hips, hands and toes always."""
    clip, other = arms_down(performer(source).walks()), performer(body).body()
    there = retarget_motion(clip, other).motion
    back = retarget_motion(there, RiggedCharacter.of(clip)[1]).motion
    away = (back.joint_positions() - clip.joint_positions()).norm(dim=-1)
    assert float(away.mean(dim=0).max()) < 0.01
    ends = [0, *(CANONICAL.index(side + "Hand") for side in ("left", "right")), *FEET, *TOES]
    assert float(away[:, ends].max()) < 0.01


@pytest.mark.parametrize("lower", [0.02, -0.02])
def test_hips_follow_the_feet_of_straight_legs_both_ways(lower):
    """Up as well as down, so that the way back undoes it; bent legs give in instead."""
    ankles = {}
    for upright in (0.995, 0.85):
        clip = Performer(upright=upright).stands() if upright > 0.9 else crouching()
        positions = clip.joint_positions()[:, FEET].clone()
        positions[..., 1] -= lower
        fitted = fit_hips(clip, positions, limb_extension(clip, LEGS))
        ankles[upright] = float((clip.root_position - fitted.root_position)[:, 1].mean())
    assert ankles[0.995] == pytest.approx(lower, abs=0.002)
    assert ankles[0.85] == pytest.approx(0.0, abs=0.002)


def crouching() -> Motion:
    """A body that stands still on bent knees."""
    bent = torch.full((60,), 1.0, dtype=torch.float64)
    turned = {joint: sign * bent for joints, sign in ((HIPJOINTS, -0.5), (KNEES, 1.0)) for joint in joints}
    return USUAL.stands(turned=turned)


def test_a_kick_is_the_same_pose():
    """The leg points where it did, however long it is and however far the foot is from its place in scale."""
    up = torch.sin(torch.linspace(0, math.pi, 60, dtype=torch.float64)) ** 2
    clip = USUAL.stands(turned={HIPJOINTS[0]: -1.6 * up})
    for body in (PEOPLE["short legs"], replace(PEOPLE["long flat foot"], thighs_drop=0.12)):
        done = retarget_motion(clip, RiggedCharacter.of(body.walks())[1])
        assert done.changes.notes == ()
        ways = [m.joint_positions()[30, FEET[0]] - m.joint_positions()[30, HIPJOINTS[0]] for m in (clip, done.motion)]
        assert float(torch.nn.functional.cosine_similarity(*ways, dim=0)) > math.cos(math.radians(1))


def test_a_table_that_lays_feet_as_anothers_is_put_right():
    """A LaFAN-like rig whose foot is flatter than the table has it: no tip-toe (its own pitch, not the canonical)."""
    clip = _lafan_like()
    own, body = RiggedCharacter.of(clip)
    assert body.rigmap.rig.name == "lafan1"
    assert float(torch.rad2deg(body.stance.tilt[:, 0]).min()) > 8
    done = retarget_motion(
        retarget.from_canonical(USUAL.walks(), retarget.identify_rig(bandai_skeleton())), body
    ).motion
    torch.testing.assert_close(foot_pitch_deg(done), foot_pitch_deg(own), atol=1.5, rtol=0)


def test_a_person_of_a_rig_has_flat_feet_and_the_clips_floor(tmp_path):
    """Body that `follow`, `generate`, `steer` and `run` take from a clip: also where its toes lie below zero."""
    clip = replace(_lafan_like(), source=None)
    clip = replace(clip, root_position=clip.root_position - torch.tensor([0.0, 0.04, 0.0]).double())
    clip.save(tmp_path / "rig.bvh")
    person = inputs.read_character(str(tmp_path / "rig.bvh"))
    own = retarget.to_canonical(mapctl.load(tmp_path / "rig.bvh"))[0]
    assert person.toe_rest_height == pytest.approx(float(low_toes(own).mean()), abs=1e-6)
    assert person.toe_rest_height < -0.005
    way = person.skeleton.offsets[TOES]
    slope = torch.rad2deg(torch.atan2(way[:, 1], way[:, 2]))
    torch.testing.assert_close(slope, foot_pitch_deg(own), atol=1.5, rtol=0)
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, CANONICAL.num_joints, 4)
    flat = Motion(person.skeleton, own.fps, torch.zeros(1, 3, dtype=torch.float64), still)
    positions = retarget.to_canonical(person.on_rig(flat))[0].joint_positions()[0]
    down = positions[TOES] - positions[FEET]
    slope = torch.rad2deg(torch.atan2(down[:, 1], down[:, 2]))
    torch.testing.assert_close(slope, foot_pitch_deg(own), atol=1.5, rtol=0)


def _lafan_like(frames: int = 90) -> Motion:
    """LaFAN1's names and zero pose, every bone along x, on a performer whose feet are flatter than in its table."""
    result = make(Make(names_of("lafan1"), bones_along_x=True, extras=False))
    canonical = FLAT.walks(frames)
    motion = result.motion(canonical)
    slope = math.atan2(0.0749, 0.0906) - math.atan2(-FLAT.foot[0], FLAT.foot[1])
    up = quat_xyzw(torch.tensor([0.0, 0.0, slope], dtype=torch.float64)).expand(frames, 4)  # across the foot
    local, offsets = motion.local_quat_xyzw.clone(), result.skeleton.offsets.clone()
    for k, side in enumerate(("Left", "Right")):
        foot, toe = (result.skeleton.index(side + part) for part in ("Foot", "Toe"))
        local[:, foot] = rotations.multiply(local[:, foot], up)
        local[:, toe] = rotations.multiply(rotations.inverse(up), local[:, toe])
        for part, joint in (("Leg", KNEES[k]), ("Foot", FEET[k]), ("Toe", TOES[k])):
            own = result.skeleton.index(side + part)
            offsets[own] = offsets[own] / offsets[own].norm() * canonical.skeleton.offsets[joint].norm()
    hips = canonical.root_position
    return replace(
        motion, skeleton=replace(result.skeleton, offsets=offsets), root_position=hips, local_quat_xyzw=local
    )


MIXAMO, UE5 = (make(Make(names_of(name), arms_down_deg=down)) for name, down in (("mixamo", 0.0), ("ue5", 45.0)))
FINGERS = [f"{side}_{finger}_bone" for side in "LR" for finger in ("Thumb1", "Index1")]


def test_numbers_of_a_walk():
    clip, body = Performer().walks(), Performer(size=1.25, toe_height=0.02).body()
    found = retarget_motion(clip, body)
    assert found.changes.scale == pytest.approx(1.25)
    assert found.changes.hips_lowered_m < 0.01
    assert found.changes.feet_missed.frames == found.changes.hands_missed.frames == 0
    assert found.changes.unmatched_joints == found.changes.notes == ()


def test_joints_that_move_and_have_no_counterpart_are_named():
    """Not so a joint of the spine, whose turns the chest has; nor fingers that the other rig has."""
    clip = MIXAMO.motion(walk(40))
    plain = RiggedCharacter.of(make(Make(names_of("ue5"), extras=False)).motion(walk(40)))[1]
    left = retarget_motion(clip, plain).changes.unmatched_joints
    assert {*FINGERS, "Prop_sword"} <= {*left}
    assert "Middle" not in left
    like = RiggedCharacter.of(UE5.motion(walk(40)))[1]
    assert not {*FINGERS} & {*retarget_motion(clip, like).changes.unmatched_joints}


def test_fingers_turn_as_the_givers_in_the_tposes_frames():
    clip, body = MIXAMO.motion(walk(40)), RiggedCharacter.of(UE5.motion(walk(40)))[1]
    found = retarget_motion(clip, body)
    result = body.on_rig(found.motion, fingers=found.fingers)
    for name in FINGERS:
        hand = ("left" if name.startswith("L") else "right") + "Hand"
        added = []
        for motion, rig in ((clip, MIXAMO), (result, UE5)):
            frame = rig.tpose[hand]
            turn = Rotation.from_quat(motion.local_quat_xyzw[:, motion.skeleton.index(name)].numpy())
            added.append(frame * turn * frame.inv())
        assert max((added[0].inv() * added[1]).magnitude()) < 1e-6
        assert max(added[0].magnitude()) > 0.05


CLIMBS = Performer(stair=0.10, upright=0.9)
OTHERS = {"small": Performer(size=0.8, toe_height=0.03), "tall": Performer(size=1.2, toe_height=0.05)}


def climb() -> tuple[Motion, RiggedCharacter]:
    """Up a stair from the floor, after a while on the floor that shows how high toes rest."""
    return CLIMBS.walks(100), Performer().body()


def stands(motion: Motion, clip: Motion) -> torch.Tensor:
    """Toe heights by frame and foot where the clip's feet stand, nan elsewhere."""
    still = clip.joint_positions()[:, TOES].diff(dim=0, prepend=clip.joint_positions()[:1, TOES]).norm(dim=-1) < 1e-6
    return torch.where(still, motion.joint_positions()[:, TOES, 1], torch.nan)


@pytest.mark.parametrize("mode", ["fit", "keep"])
@pytest.mark.parametrize("name", OTHERS)
def test_steps_are_as_high_as_asked(mode: GroundMode, name):
    clip, source = climb()
    body = OTHERS[name].body()
    done = retarget_canonical(clip, source, body, ground=mode)
    scale = leg_length(body.leveled) / leg_length(clip.skeleton)
    factor = scale if mode == "fit" else 1.0
    over = stands(clip, clip) - Performer().toe_height
    got = stands(done.motion, clip) - OTHERS[name].toe_height
    high = over > 0.05
    assert int(high.sum()) > 40
    assert float((got - factor * over)[high].abs().max()) < 0.012
    assert done.changes.feet_missed.frames == 0


@pytest.mark.parametrize(("height", "kept"), [(0.045, True), (0.02, False)])
def test_a_low_platform_is_kept_only_where_that_is_asked(height, kept):
    """From 3 cm on: less may be the height of the toe joints."""
    walk, body = Performer().walks(), OTHERS["tall"].body()
    clip = replace(walk, root_position=walk.root_position + torch.tensor([0.0, height, 0.0], dtype=torch.float64))
    low = {
        mode: float(retarget_motion(clip, body, ground=mode).motion.joint_positions()[:, TOES, 1].quantile(0.05))
        for mode in ("fit", "keep")
    }
    assert low["fit"] == pytest.approx(0.05, abs=0.008)
    assert low["keep"] == pytest.approx(0.05 + (height if kept else 0.0), abs=0.008)


def test_a_foot_that_is_held_up_stands_on_nothing():
    """At the height of a kick, and while the body is not over it."""
    up = torch.full((60,), -1.2, dtype=torch.float64)
    clip = Performer().stands(turned={HIPJOINTS[0]: up, FEET[0]: -up})
    _, height = find_ground(clip, Performer().body().stance)
    assert height.abs().max() == 0
