"""Time in the live viewer: frames that are kept, the past that is shown, slow motion, and sigmas."""

import time

import numpy as np
import pytest
from stage import delivered, run

from mapctl.skeleton import CANONICAL
from scenes.live.bodies.body import BodyPose, blend_poses
from scenes.live.realtime import RealtimeMonitor
from scenes.live.timeline.ring import FrameRing


def test_the_ring_keeps_the_newest_frames_in_the_memory_that_it_had():
    ring = FrameRing(CANONICAL, seconds=2.0)
    assert (len(ring), ring.find(0.0)) == (0, None)
    memory = ring.memory_bytes
    for number in range(75):
        ring.add(number / 30, delivered(number // 3 * 3 % 75), number % 3)
        assert len(ring) == min(60, number + 1)
    assert ring.memory_bytes == memory < 60 * 400
    assert (ring.oldest, ring.newest) == (pytest.approx(15 / 30), pytest.approx(74 / 30))
    whole = delivered(0, 75).motion(CANONICAL)
    for asked, number, share in ((1.0, 30, 0.0), (30.5 / 30, 30, 0.5), (0.0, 15, 0.0), (99.0, 74, 0.0)):
        found = ring.find(asked)
        assert found is not None
        assert (found.number, found.share) == (number, pytest.approx(share, abs=1e-6))
        np.testing.assert_allclose(found.motion.joint_positions()[0], whole.joint_positions()[number], atol=1e-5)
    track = ring.track(0.9, 1.1, 5)
    np.testing.assert_allclose(track[2], whole.root_position[30, ::2], atol=1e-5)


def test_times_that_go_back_do_not_break_the_order():
    ring = FrameRing(CANONICAL, seconds=1.0)
    for number in (0.0, 1.0, 0.5, 2.0):
        ring.add(number, delivered(), 0)
    assert [ring.find(at).number for at in (0.5, 1.0, 1.5, 2.0)] == [0, 2, 2, 3]


def test_poses_are_blended_along_the_shorter_way():
    first, second = (
        BodyPose(np.full((1, 3), at), np.array([quat]))
        for at, quat in ((0.0, (0, 0, 0, 1.0)), (1.0, (0, -0.6, 0, -0.8)))
    )
    half = blend_poses(first, second, 0.5)
    np.testing.assert_allclose(half.positions, 0.5)
    np.testing.assert_allclose(np.abs(half.quat_xyzw), [[0, np.sqrt(0.1), 0, np.sqrt(0.9)]], atol=1e-6)
    assert blend_poses(first, second, 0.0) is first


def words(actor) -> list[tuple]:
    return [heard for heard in actor.heard if heard[0] in ("pause", "rate", "tune")]


@pytest.mark.slow
def test_who_looks_back_sees_what_was_and_the_characters_wait(show, actors):
    run(show, 90)
    timeline, member = show._timeline, show._cast.members[0]
    assert timeline.kept_seconds > 0.3
    shown = timeline.clock.now()
    show.look_back(0.3)
    run(show, 2)
    assert [words(actor) for actor in actors] == [[("pause", True)]] * 2
    assert timeline.seconds_back == pytest.approx(0.3, abs=1e-6)
    past = member.ring.find(timeline.cursor)
    assert past is not None
    np.testing.assert_allclose(member.place, past.motion.root_position[0, ::2], atol=1e-5)
    assert timeline.cursor < shown
    before = member.place.copy()
    run(show, 5)
    np.testing.assert_array_equal(member.place, before)
    show.look_back(1e9)
    run(show, 16)
    assert timeline.seconds_back == pytest.approx(timeline.kept_seconds)
    assert "The past" in show._times._text.content
    assert show._times._slider.value == pytest.approx(-timeline.seconds_back, abs=0.06)
    show.return_to_present()
    run(show, 2)
    assert words(actors[0])[-1] == ("pause", False)
    assert timeline.cursor is None


@pytest.mark.slow
def test_who_stood_before_stands_after_and_to_go_on_or_to_reset_is_to_come_back(show, actors):
    run(show, 30)
    show.toggle_pause()
    show.look_back(0.1)
    show.return_to_present()
    run(show, 1)
    assert words(actors[0])[-1] == ("pause", True)
    show.look_back(0.1)
    show.toggle_pause()
    run(show, 1)
    assert (words(actors[0])[-1], show._timeline.cursor) == (("pause", False), None)
    show.look_back(0.1)
    show.reset()
    run(show, 1)
    assert actors[0].heard[-1] == ("reset",)
    assert (words(actors[0])[-1], show._timeline.cursor) == (("pause", False), None)


@pytest.mark.slow
def test_a_replay_ends_in_the_present(show, actors):
    run(show, 40)
    show.replay()
    run(show, 3)
    timeline = show._timeline
    assert timeline.is_replaying
    back = timeline.seconds_back
    run(show, 5)
    assert timeline.seconds_back < back
    until = time.monotonic() + 20
    while timeline.cursor is not None and time.monotonic() < until:
        run(show, 5)
    assert timeline.cursor is None
    assert words(actors[0])[-1] == ("pause", False)


def test_slow_motion_reaches_all_and_what_waits_waits_longer(show, actors):
    members = show._cast.members
    run(show, 2)
    show.set_rate(0.25)
    run(show, 1)
    assert [words(actor) for actor in actors] == [[("rate", 0.25)]] * 2
    member, now = members[0], time.perf_counter()
    member._waiting.clear()
    chunk = delivered()
    member.take(chunk, now)  # as it was made before the rate changed
    spans = np.diff([one.due for one in member._waiting])
    np.testing.assert_allclose(spans, 4 / 30)
    member.set_rate(0.5, now)
    np.testing.assert_allclose(np.diff([one.due for one in member._waiting]), 2 / 30)
    member.postpone(1.0)
    assert member._waiting[0].due == pytest.approx(now + (chunk.due - now) * 2 + 1.0)


def test_between_two_frames_slow_motion_is_smooth(show):
    member, now = show._cast.members[0], time.perf_counter()
    member.set_rate(0.5, now)
    member.take(delivered(), now)
    first, second = member._waiting[0], member._waiting[1]
    member.show_due(first.due + 1e-4, 0.0)
    member.show_due((first.due + second.due) / 2, 0.0)
    middle = (first.chunk.root[0, ::2] + first.chunk.root[1, ::2]) / 2
    np.testing.assert_allclose(member.place, middle, atol=1e-9)


def test_who_is_slow_because_of_slow_motion_keeps_up():
    pace = RealtimeMonitor()
    pace.set_rate(0.125)
    for step in range(20):
        chunk = delivered(3 * step % 75)
        pace.add(0.8 * step, chunk)
        assert not pace.judge(0.8 * step + 0.79)
    assert pace.judge(0.8 * 19 + 7.0), "but not where nothing comes"
    pace.forget()
    assert pace.slow
    assert pace.text(30.0) == "no frame since it was stopped"


def test_sigmas_are_each_characters_own_and_reset_alone(show, actors):
    sigmas = show._sigmas
    sigmas.change("speed", 1.0)
    sigmas.change("noise", -1)
    run(show, 1)
    assert words(actors[0]) == [("tune", {"speed": 0.2}), ("tune", {"speed": 0.2, "noise": 1.0})]
    assert sigmas.sliders["speed"].label == "Speed, 0.2 m/s"
    show.choose(1)
    run(show, 1)
    assert (sigmas.sliders["speed"].value, sigmas.sliders["speed"].label) == (0.0, "Speed, 0.1 m/s")
    sigmas.reset()
    show.choose(0)
    run(show, 1)
    assert words(actors[1]) == [("tune", {})]
    assert sigmas.sliders["speed"].value == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [9.0, 4.0, np.nan, np.inf, 1e300, "x", None, True])
def test_a_sigma_that_cannot_be_is_said_and_put_right(show, actors, wrong):
    sigmas = show._sigmas
    sigmas.change("speed", 1.0)
    sigmas.change("speed", wrong)
    run(show, 1)
    assert words(actors[0]) == [("tune", {"speed": 0.2})]
    assert sigmas._text.visible
    assert "sigma of speed" in sigmas._text.content
    run(show, 80)
    assert sigmas.sliders["speed"].value == 1.0
    sigmas.change("speed", 0.0)
    run(show, 1)
    assert not sigmas._text.visible
