"""The page on engines and its scripts: the messages of its table are those that are sent; its formula poses a rig."""

import re
import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from helpers import random_motion, run, walk
from listening import free_ports
from pages import ROOT, read_page
from scipy.spatial.transform import Rotation

from mapctl.skeleton import CANONICAL
from mapctl.streaming import sender

PAGE = read_page("docs/guides/engines.md")
SCRIPTS = {
    name: (ROOT / "docs/static" / name).read_text("utf-8") for name in ("MapctlReceiver.cs", "mapctl_receiver.gd")
}
TABLE = dict(re.findall(r"^\| `(/[\w/]+)` \| (?:`([\w.]+)`)? *\|", PAGE, re.MULTILINE))
PARENTS = {
    bone: "" if parent < 0 else sender.BONE_NAMES[parent]
    for bone, parent in zip(sender.BONE_NAMES, CANONICAL.parents, strict=True)
}
FLIP = np.array([-1.0, 1.0, 1.0])


def text(data: bytes) -> tuple[str, bytes]:
    """A padded text, and what follows."""
    found = data[: data.index(0)]
    return found.decode("ascii"), data[len(found) // 4 * 4 + 4 :]


def messages(packet: bytes) -> Iterator[tuple[str, str, list]]:
    """Address, types and arguments of each message of a bundle, read by hand."""
    assert packet.startswith(b"#bundle\0")
    rest = packet[16:]
    while rest:
        (size,) = struct.unpack(">i", rest[:4])
        data, rest = rest[4 : 4 + size], rest[4 + size :]
        address, data = text(data)
        tags, data = text(data)
        values = []
        for tag in tags[1:]:
            if tag == "s":
                value, data = text(data)
            else:
                (value,), data = struct.unpack(f">{tag}", data[:4]), data[4:]
            values.append(value)
        yield address, tags[1:], values


def types_of(sent) -> dict[str, str]:
    """Types by address, as the table has them: the forecast has as many points as there are."""
    found = {address: types for address, types, _ in sent}
    points = found["/mapctl/forecast"]
    assert points == "fff" * (len(points) // 3)
    return found | {"/mapctl/forecast": "fff..."}


def packets(motion, frame: int = 0) -> list[bytes]:
    guidance = sender.Guidance(np.array([1.0, 0.0]), np.array([0.5, 1.25]), np.zeros((6, 3)))
    root, quats = motion.root_position[frame].numpy(), motion.local_quat_xyzw[frame].numpy()
    return sender.pack(sender.encode_frame(motion.skeleton, root, quats, 0.5, guidance=guidance))


def test_the_table_has_the_messages_of_a_frame():
    sent = [message for packet in packets(walk(1)) for message in messages(packet)]
    assert types_of(sent) == TABLE
    assert sum(address == "/VMC/Ext/Bone/Pos" for address, _, _ in sent) == 21
    assert [address for address, _, _ in sent][-3:] == ["/VMC/Ext/Blend/Apply", "/VMC/Ext/OK", "/VMC/Ext/T"]


@pytest.mark.slow
def test_a_steered_script_sends_these_messages(prior, tmp_path):
    port = free_ports(1)
    (tmp_path / "c.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n1,1.2,0\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", port))
        listener.settimeout(5.0)
        words = ("steer", tmp_path / "c.csv", "-o", tmp_path / "out.npz", "--prior", prior, "--realtime", "--quiet")
        assert run(*words, "--stream", f":{port}") == 0
        for _ in range(10):
            first, second = [*messages(listener.recv(65536))], [*messages(listener.recv(65536))]
            assert types_of(first + second) == TABLE
            assert first[0] == second[0] == ("/mapctl/frame", "f", second[-1][2])


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_reads_messages_that_are_sent(name):
    read = {address: types for address, types in re.findall(r'"(/[\w/]+)(?:", ")?,(\w+)"', SCRIPTS[name])}
    assert read.keys() == TABLE.keys() - {"/mapctl/forecast", "/VMC/Ext/Blend/Apply", "/VMC/Ext/OK"}
    assert read.items() <= TABLE.items()


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_has_the_tree_of_the_bones_parents_first(name):
    found = re.findall(r'"(\w+)"[:,] "(\w*)"', SCRIPTS[name].split("Parents" if name.endswith("cs") else "PARENTS")[1])
    tree = dict(found[: len(PARENTS)])
    assert tree == PARENTS
    assert all(parent in ["", *list(tree)[:k]] for k, parent in enumerate(tree.values()))


def test_the_godot_script_is_understood_by_a_parser():
    parser = pytest.importorskip("gdtoolkit.parser", reason="needs gdtoolkit: pip install gdtoolkit")
    assert parser.parser.parse(SCRIPTS["mapctl_receiver.gd"]).children
    with pytest.raises(Exception, match="Unexpected"):
        parser.parser.parse(SCRIPTS["mapctl_receiver.gd"].replace("func _ready()", "func _ready("))


@pytest.mark.parametrize("left_handed", [True, False], ids=["Unity", "Godot"])
def test_a_rig_of_any_axes_is_posed_by_the_formula_of_the_page(left_handed):
    """Local rotations `inverse(P) * q * R` on bones of random axes; scaled by the length of the leg."""
    motion, scale = random_motion(CANONICAL, 1, seed=3), 1.2
    flip = FLIP if left_handed else np.ones(3)
    local = {}
    for packet in packets(motion):
        local |= {v[0]: np.array(v[1:]) for address, _, v in messages(packet) if address == "/VMC/Ext/Bone/Pos"}
    if not left_handed:  # as the page has it: x is reversed
        local = {bone: values * [-1, 1, 1, 1, -1, -1, 1] for bone, values in local.items()}
    axes = {bone: Rotation.random(random_state=k) for k, bone in enumerate(["", *PARENTS])}
    axes[""] = Rotation.identity()
    leg = sum(np.linalg.norm(local[bone][:3]) for bone in ("LeftLowerLeg", "LeftFoot"))
    offsets = scale * CANONICAL.offsets.numpy() * flip  # the rig's, in the T-pose
    own_leg = sum(np.linalg.norm(offsets[CANONICAL.index(joint)]) for joint in ("leftLowerLeg", "leftFoot"))
    assert own_leg / leg == pytest.approx(scale)
    posed = {"": (np.zeros(3), Rotation.identity())}
    for bone, offset, joint in zip(PARENTS, offsets, motion.joint_positions()[0].numpy(), strict=True):
        above, parent = posed[PARENTS[bone]], axes[PARENTS[bone]]
        turn = above[1] * parent.inv() * Rotation.from_quat(local[bone][3:]) * axes[bone]
        at = above[0] + above[1].apply(parent.inv().apply(offset))
        posed[bone] = (own_leg / leg * local["Hips"][:3] if bone == "Hips" else at, turn)
        np.testing.assert_allclose(posed[bone][0], scale * joint * flip, atol=1e-5)
