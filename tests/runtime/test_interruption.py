"""Ctrl-C and SIGTERM: raised at once, held back while something must be whole, and doubled ones taken for one."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from mapctl.runtime import interruption
from mapctl.runtime.interruption import SIGNALS, defer_signals, raise_on_signals

ALL = pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)


@pytest.fixture(autouse=True)
def handlers():
    """As a command begins with them; what tests install is taken away again."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is moved."""

    class Clock:
        seconds = 100.0

        def monotonic(self):
            return self.seconds

    found = Clock()
    monkeypatch.setattr(interruption, "time", found)
    return found


def send(number=signal.SIGINT):
    os.kill(os.getpid(), number)


@ALL
def test_every_signal_interrupts_once_and_is_remembered(number, clock):
    received = raise_on_signals()
    with pytest.raises(KeyboardInterrupt):
        send(number)
    clock.seconds += 0.9
    send(number)  # `timeout` sends it to the process and to its group
    assert received == [number]
    clock.seconds += 0.2
    with pytest.raises(KeyboardInterrupt):
        send(number)


@ALL
def test_what_is_to_be_ignored_stays_ignored(number):
    signal.signal(number, signal.SIG_IGN)
    raise_on_signals()
    send(number)
    with defer_signals() as held:
        send(number)
    assert held.wanted is None


def done_by(work):
    """What work had done when it was interrupted."""
    done = []
    with pytest.raises(KeyboardInterrupt):
        work(done)
    return done


@ALL
def test_held_signals_wait_until_they_are_released(number, clock):
    def work(done):
        with defer_signals() as held:
            send(number)
            send(signal.SIGINT)
            done.append(held.wanted)
            held.release()
            done.append("never")

    assert done_by(work) == [number]


def test_a_signal_that_still_waits_at_the_end_is_let_go_then():
    def work(done):
        with defer_signals():
            send(signal.SIGTERM)
            done.append("whole")
        done.append("never")

    received = raise_on_signals()
    before = signal.getsignal(signal.SIGTERM)
    assert done_by(work) == ["whole"]
    assert received == [signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_second_wish_is_not_held_back_but_saving_is(clock):
    def work(done):
        with defer_signals() as held:
            send()
            clock.seconds += 0.9
            send()
            done.append("a double one")
            with held.defer_all():
                clock.seconds += 5
                send()
                done.append("saved")
            send()
            done.append("never")

    assert done_by(work) == ["a double one", "saved"]


def test_signals_go_through_where_that_is_allowed():
    def at_once(done):
        with defer_signals() as held, held.let_through():
            done.append("begun")
            send()
            done.append("never")

    def waiting(done):
        with defer_signals() as held:
            send()
            done.append("held")
            with held.let_through():
                done.append("never")

    assert (done_by(at_once), done_by(waiting)) == (["begun"], ["held"])


def test_nothing_is_held_where_no_signals_arrive():
    """As in a thread of a program that trains in the background."""
    found = []

    def work():
        with defer_signals() as held:
            held.release()
            with held.let_through(), held.defer_all():
                found.append(held.wanted)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [None]


def test_a_programs_own_handler_is_asked_and_put_back():
    found = []
    own = lambda number, frame: found.append(number)  # noqa: E731
    signal.signal(signal.SIGTERM, own)
    with defer_signals() as held:
        send(signal.SIGTERM)
        assert found == []
        held.release()
        assert (found, held.wanted) == ([signal.SIGTERM], None)
    assert signal.getsignal(signal.SIGTERM) is own


def test_a_signal_in_the_compiler_comes_again_until_it_is_out():
    """LLVM swallows what its callbacks raise: Ctrl-C while kernels are compiled would be lost."""
    code = """if True:
        import signal, time
        from mapctl.runtime.interruption import raise_on_signals
        raise_on_signals()
        inside = {"signal": signal, "time": time}
        exec(compile("signal.raise_signal(signal.SIGINT); done = True", "llvmlite/callback.py", "exec"), inside)
        try:
            time.sleep(20)
        except KeyboardInterrupt:
            print("caught after", inside.get("done"))
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "caught after True\n"
