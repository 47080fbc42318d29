"""A character in a process of its own: it moves, obeys, pauses, begins anew, and says why it cannot."""

import functools
import time
from itertools import pairwise

import numpy as np
import pytest
from tiny_prior import save_tiny_prior

import priors
from controllers.remote import Remote, RemoteRequest
from mapctl.errors import MapctlError, RequestError
from mapctl.steering import Command
from mapctl.streaming import LiveCharacter


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    return functools.partial(priors.load, str(save_tiny_prior(tmp_path_factory.mktemp("p") / "tiny.safetensors")))


@pytest.fixture(scope="module")
def remote(load):
    made = Remote(RemoteRequest(load, Command(1.2, 0.0), at=(3.0, -1.0)))
    made.wait()
    yield made
    made.close()
    made.close()


def collected(remote, seconds):
    found, until = [], time.perf_counter() + seconds
    while time.perf_counter() < until:
        found += remote.poll()
        time.sleep(0.01)
    return found


def test_it_is_a_live_character_that_walks_in_time(remote):
    assert isinstance(remote, LiveCharacter)
    remote.reset()
    collected(remote, 0.3)
    pieces = collected(remote, 2.0)
    frames = sum(len(piece.root) for piece in pieces)
    assert 50 <= frames <= 70
    assert all(b.due > a.due for a, b in pairwise(pieces))
    assert all(np.isfinite(piece.quats).all() for piece in pieces)
    assert set(pieces[-1].energies) == {"noise", "travel", "footing"}
    motion = pieces[-1].motion(remote.skeleton)
    assert motion.joint_positions().shape == (3, 21, 3)
    assert pieces[-1].root[-1, 2] > pieces[0].root[0, 2], "it goes along +z"


def test_it_turns_when_told_and_walks_a_path(remote):
    remote.command(Command(1.2, np.pi / 2))
    last = collected(remote, 2.5)[-1]
    assert np.argmax(np.abs(last.wish)) == 0, "the wish is along x"
    assert last.wish[0] == pytest.approx(1.2, abs=0.05)
    here = last.root[-1]
    remote.walk([(here[0], here[2]), (here[0], here[2] - 1), (here[0], here[2] - 9)], 1.0)
    assert collected(remote, 2.0)[-1].wish[1] < -0.3
    with pytest.raises(RequestError):
        remote.walk([(0.0, 0.0)], 1.0)


def test_a_pause_stops_time_and_going_on_loses_none(remote):
    remote.command(Command(1.0, 0.0))
    before = collected(remote, 0.5)[-1]
    remote.pause(True)
    collected(remote, 0.5)
    assert collected(remote, 0.5) == []
    remote.pause(False)
    after = collected(remote, 1.0)
    assert after[0].seconds - before.seconds < 0.6
    assert after[-1].spare > -0.05, "the pause made nothing late"


def test_reset_brings_it_back_to_where_it_stood(remote):
    remote.reset()
    first = next(piece for piece in collected(remote, 1.0) if len(piece.root) == 1)
    np.testing.assert_allclose(first.root[0, ::2], [3.0, -1.0], atol=1e-5)


def test_what_it_cannot_load_is_said():
    broken = Remote(RemoteRequest(functools.partial(priors.load, "nobody"), Command(1.0, 0.0)))
    with pytest.raises(RequestError, match="no prior 'nobody'"):
        broken.wait()


def test_a_process_that_is_gone_is_said(load):
    lost = Remote(RemoteRequest(load, Command(1.0, 0.0)))
    lost.wait()
    assert lost.memory_mb() > 10
    lost._process.terminate()
    lost._process.join()
    with pytest.raises(MapctlError, match="ended by itself"):
        collected(lost, 1.0)
    lost.close()
