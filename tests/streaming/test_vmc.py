"""Poses as VMC messages: what a Unity program would make of them, and back."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import random_motion, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.streaming import sender
from mapctl.streaming.messages import Message
from mapctl.streaming.receiver import read_messages
from mapctl.streaming.sender import pack

PARENTS = {
    "Spine": "Hips",
    "Chest": "Spine",
    "Neck": "Chest",
    "Head": "Neck",
    **{f"{side}UpperLeg": "Hips" for side in ("Left", "Right")},
    **{f"{side}LowerLeg": f"{side}UpperLeg" for side in ("Left", "Right")},
    **{f"{side}Foot": f"{side}LowerLeg" for side in ("Left", "Right")},
    **{f"{side}Toes": f"{side}Foot" for side in ("Left", "Right")},
    **{f"{side}Shoulder": "Chest" for side in ("Left", "Right")},
    **{f"{side}UpperArm": f"{side}Shoulder" for side in ("Left", "Right")},
    **{f"{side}LowerArm": f"{side}UpperArm" for side in ("Left", "Right")},
    **{f"{side}Hand": f"{side}LowerArm" for side in ("Left", "Right")},
}
"""The tree as Unity's documentation draws it."""
FLIP = np.diag([-1.0, 1.0, 1.0])


def body(seed: int) -> Skeleton:
    """Canonical joints with bones of any length."""
    offsets = CANONICAL.offsets * (0.5 + torch.rand(21, 1, generator=torch.Generator().manual_seed(seed)).double())
    return replace(CANONICAL, offsets=offsets)


def frame(seed: int):
    """A random pose of a random body, and its messages."""
    motion = random_motion(body(seed), 1, seed=seed)
    root, quats = motion.root_position[0].numpy(), motion.local_quat_xyzw[0].numpy()
    return motion, sender.encode_frame(motion.skeleton, root, quats, 1.5)


def sent_over(messages):
    """Messages after packing, as 32-bit numbers."""
    return unpacked(pack(messages))


def assembled(messages):
    assembler = sender.FrameAssembler()
    return [found for message in messages if (found := assembler.take(message)) is not None]


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), root_travels=st.booleans())
def test_joints_come_back(seed, root_travels):
    motion = random_motion(body(seed), 1, seed=seed)
    root, quats = motion.root_position[0].numpy(), motion.local_quat_xyzw[0].numpy()
    messages = sender.encode_frame(motion.skeleton, root, quats, 12.25, root_travels=root_travels)
    (exact,) = assembled(messages)
    np.testing.assert_allclose(exact.joint_positions(), motion.joint_positions()[0], atol=1e-12)
    np.testing.assert_array_equal(exact.bone_quats_xyzw, quats)
    (found,) = assembled(sent_over(messages))
    assert found.seconds == 12.25
    np.testing.assert_allclose(found.joint_positions(), motion.joint_positions()[0], atol=3e-6)


@pytest.mark.parametrize("seed", range(2))
def test_a_left_handed_program_rebuilds_the_body(seed):
    """By its own tree and by scipy: whatever shares no code with the project."""
    motion, messages = frame(seed)
    local = {m.arguments[0]: m.arguments[1:] for m in sent_over(messages) if m.address == sender.BONE}

    def world(name):
        position, turn = np.array(local[name][:3]), Rotation.from_quat(local[name][3:])
        if name == "Hips":
            return position, turn
        at, above = world(PARENTS[name])
        return at + above.apply(position), above * turn

    for joint, name in enumerate(sender.BONE_NAMES):
        np.testing.assert_allclose(FLIP @ world(name)[0], motion.joint_positions()[0, joint], atol=3e-6)


def test_the_t_pose_has_no_rotation_and_its_left_hand_at_minus_x():
    still = np.tile([0.0, 0.0, 0.0, 1.0], (21, 1))
    messages = sender.encode_frame(CANONICAL, np.array([0.0, 0.9, 0.0]), still, 0.0)
    bones = {m.arguments[0]: m.arguments[1:] for m in messages if m.address == sender.BONE}
    assert {tuple(np.abs(values[3:])) for values in bones.values()} == {(0.0, 0.0, 0.0, 1.0)}
    assert bones["LeftUpperArm"][0] < 0 < bones["RightUpperArm"][0]
    assert bones["LeftToes"][2] > 0


def test_hips_travel_or_the_root_does():
    motion = walk(60, turn_rate=0.5)
    position, quats = motion.root_position[50].numpy(), motion.local_quat_xyzw[50].numpy()
    by_hips = sender.encode_frame(CANONICAL, position, quats, 0.0)
    by_root = sender.encode_frame(CANONICAL, position, quats, 0.0, root_travels=True)
    mirrored = FLIP @ position
    assert by_hips[0] == Message(sender.ROOT, ("root", *np.zeros(3) * [-1, 1, 1], 0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(by_hips[1].arguments[1:4], mirrored)
    np.testing.assert_allclose(by_root[0].arguments[1:4], mirrored * [1, 0, 1])
    np.testing.assert_allclose(by_root[1].arguments[1:4], mirrored * [0, 1, 0])


def test_a_frame_with_a_lost_packet_is_left_out():
    _, messages = frame(0)
    first, second = ([*read_messages(packet)] for packet in pack(messages))
    assert len(assembled([*first, *second, *second, *first, *second])) == 2
    assert assembled(second) == []


def guided(seconds: float) -> list[bytes]:
    """Packets of a random pose, with guidance."""
    motion = random_motion(body(0), 1, seed=int(10 * seconds))
    guidance = sender.Guidance(np.array([1.0, 0.0]), np.array([0.0, seconds]), np.full((6, 3), seconds))
    root, quats = motion.root_position[0].numpy(), motion.local_quat_xyzw[0].numpy()
    return pack(sender.encode_frame(motion.skeleton, root, quats, seconds, guidance=guidance))


def unpacked(packets):
    return [message for packet in packets for message in read_messages(packet)]


SENT = {seconds: guided(seconds) for seconds in (0.1, 0.2, 0.3)}
PACKETS = [packet for packets in SENT.values() for packet in packets]


@settings(max_examples=50)
@given(st.lists(st.sampled_from(PACKETS), max_size=12))
def test_whatever_packets_are_lost_doubled_or_late_no_frame_is_of_two(packets):
    for found in assembled(unpacked(packets)):
        (sent,) = assembled(unpacked(SENT[round(found.seconds, 1)]))
        np.testing.assert_array_equal(found.bone_quats_xyzw, sent.bone_quats_xyzw)
        np.testing.assert_array_equal(found.root_position, sent.root_position)
        np.testing.assert_array_equal(found.guidance.forecast, sent.guidance.forecast)


def test_a_frame_with_guidance_is_two_packets_of_1200_bytes():
    assert len(PACKETS) == 6
    assert max(map(len, PACKETS)) <= 1200


@pytest.mark.parametrize("address", [sender.CONTACTS, sender.VELOCITY, sender.FORECAST])
@pytest.mark.parametrize("numbers", [(1.0,), (1.0, math.nan), ("left", "right")])
def test_guidance_that_is_not_whole_is_left_out(address, numbers):
    messages = unpacked(SENT[0.1])
    wrong = [Message(address, numbers) if message.address == address else message for message in messages]
    (found,) = assembled(wrong)
    assert found.guidance is None


def test_the_forecast_of_each_frame_begins_a_sixth_of_a_second_after_it():
    motion = walk(40, turn_rate=0.5)
    root, quats = motion.root_position.numpy(), motion.local_quat_xyzw.numpy()
    heading = np.unwrap(2 * np.arctan2(quats[:, 0, 1], quats[:, 0, 3]))
    path = np.column_stack([root[:, ::2], heading])
    nothing = np.zeros((3, 2))
    arrays = root[:3], quats[:3], nothing, np.zeros((0, 21, 3))
    found = sender.guide(FrameChunk(0.0, 0.0, *arrays, (0.0, 0.0), 0.0, 0.0, 0.0, nothing, path[3:34]))
    for k, each in enumerate(found):
        np.testing.assert_allclose(each.forecast[:, :2], path[k + 5 : 34 : 5, :2])
        np.testing.assert_allclose(each.forecast[:, 2], np.degrees(path[k + 5 : 34 : 5, 2]), atol=1e-6)


@pytest.mark.parametrize(
    "message",
    [
        Message(sender.BONE),
        Message(sender.BONE, ("Hips", 1.0, 2.0)),
        Message(sender.BONE, ("Hips", *[math.nan] * 7)),
        Message(sender.BONE, ("Tail", *[0.0] * 7)),
        Message(sender.BONE, (3, *[0.0] * 7)),
        Message(sender.BONE, ("Hips", *["x"] * 7)),
        Message(sender.BONE, ("Hips", *[[0.0]] * 7)),
        Message("/VMC/Ext/Blend/Val", ("Joy", 1.0)),
    ],
)
def test_what_is_no_pose_is_passed_over(message):
    motion, messages = frame(1)
    (found,) = assembled([*messages[:-1], message, *messages[-1:]])
    np.testing.assert_allclose(found.joint_positions(), motion.joint_positions()[0], atol=1e-12)
