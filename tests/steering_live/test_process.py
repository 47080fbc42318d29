"""A character in a process of its own: it moves, obeys, pauses, begins anew, and says why it cannot."""

import functools
import re
import time
from itertools import pairwise
from multiprocessing import Pipe

import numpy as np
import pytest
from tiny_prior import save_tiny_prior
from tiny_stitcher import save_tiny_stitcher

import priors
from controllers.steering.process import CharacterProcess, CharacterRequest, run_worker
from mapctl.errors import RequestError
from mapctl.intent.steering import Command


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    return functools.partial(priors.load, str(save_tiny_prior(tmp_path_factory.mktemp("p") / "tiny.safetensors")))


@pytest.fixture(scope="module")
def remote(load, tmp_path_factory):
    stitcher = save_tiny_stitcher(tmp_path_factory.mktemp("s") / "tiny.safetensors")
    transitions = functools.partial(priors.load_stitcher, str(stitcher))
    result = CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), at=(3.0, -1.0), transitions=transitions))
    result.wait()
    yield result
    result.close()
    result.close()


def collected(remote, seconds):
    found, until = [], time.perf_counter() + seconds
    while time.perf_counter() < until:
        found += remote.poll()
        time.sleep(0.01)
    return found


@pytest.mark.slow
def test_a_hand_goes_to_what_is_aimed_at(remote):
    remote.command(Command(0.0, 0.0))
    remote.reset()
    last = collected(remote, 1.0)[-1].motion(remote.skeleton).joint_positions()[-1]
    hand, shoulder = (remote.skeleton.index(name) for name in ("leftHand", "leftUpperArm"))
    position = tuple((last[shoulder] + last.new_tensor([0.3, 0.2, 0.1])).tolist())
    remote.aim(Command(0.0, 0.0, reach={"leftHand": position}))
    pieces = collected(remote, 2.0)
    away = [
        float((piece.motion(remote.skeleton).joint_positions()[-1, hand] - last.new_tensor(position)).norm())
        for piece in pieces
    ]
    assert min(away) < 0.5 * away[0]
    remote.aim(Command(0.0, 0.0))
    remote.command(Command(1.2, 0.0))


@pytest.mark.slow
def test_a_target_is_reached_and_one_too_far_is_reported(remote):
    remote.command(Command(0.5, 0.0))
    remote.reset()
    x, _, z = collected(remote, 1.0)[-1].root[-1]
    remote.go(Command(0.5, 0.0), (x + 0.2, z + 0.4), 0.7, 1.0)
    pieces = collected(remote, 1.5)
    away = np.concatenate([piece.root[:, ::2] for piece in pieces]) - np.array([x + 0.2, z + 0.4])
    assert np.linalg.norm(away, axis=1).min() < 0.001
    assert not [note for piece in pieces for note in piece.notes]
    remote.go(Command(0.5, 0.0), (x + 100.0, z), 0.7)
    notes = [note for piece in collected(remote, 1.0) for note in piece.notes]
    assert len(notes) == 1
    assert "m/s is the fastest" in notes[0]
    with pytest.raises(RequestError, match="finite"):
        remote.go(Command(0.5, 0.0), (np.nan, 0.0), 0.7)


def test_it_walks_in_time(remote):
    remote.reset()
    collected(remote, 0.3)
    pieces = collected(remote, 2.0)
    frames = sum(len(piece.root) for piece in pieces)
    assert 50 <= frames <= 70
    assert all(b.due > a.due for a, b in pairwise(pieces))
    assert all(np.isfinite(piece.quats).all() for piece in pieces)
    motion = pieces[-1].motion(remote.skeleton)
    assert motion.joint_positions().shape == (3, 21, 3)
    assert pieces[-1].root[-1, 2] > pieces[0].root[0, 2], "it goes along +z"


def notes(remote, seconds=1.0):
    return [note for piece in collected(remote, seconds) for note in piece.notes]


def sent_by(here, there, load):
    """All messages of a worker in this process, until it ends."""
    run_worker(there, CharacterRequest(load, Command(1.0, 0.0)))
    messages = []
    while here.poll():
        messages.append(here.recv())
    return messages


def test_an_end_that_is_wanted_is_no_failure(load):
    """Else who is started anew after an end is taken for ended, too."""
    here, there = Pipe()
    here.send(("close",))
    words = [word for word, *_ in sent_by(here, there, load)]
    assert "ready" in words
    assert "failed" not in words


def test_a_worker_sends_what_ends_it():
    here, there = Pipe()
    last = sent_by(here, there, functools.partial(priors.load, "nobody"))[-1]
    assert last[0] == "failed"
    assert re.search("no prior 'nobody'", last[1])
