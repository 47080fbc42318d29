"""A process that prepares once and forks children: what they share, when they end, and when none can be forked."""

import functools
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from mapctl.runtime import forking
from mapctl.runtime.forking import ForkingProcess, SharedBases, can_fork_for

pytestmark = pytest.mark.skipif(not forking.AVAILABLE, reason="processes are forked on Linux only")


def prepare(threads=0):
    for _ in range(threads):
        threading.Thread(target=time.sleep, args=(60.0,), daemon=True).start()
    return {"prepared by": os.getpid()}


def answer(connection, prepared, *arguments):
    connection.send((prepared, arguments, os.getpid(), threading.active_count()))
    while (said := connection.recv()) != "end":
        connection.send(said)


def fail(connection, prepared):
    raise ZeroDivisionError


@pytest.fixture
def base():
    made = ForkingProcess(prepare, answer)
    yield made
    made.close()
    made.close()


def test_children_share_what_was_prepared_and_have_a_process_each(base):
    started = [base.start("argument", number) for number in range(2)]
    told = [connection.recv() for connection, _ in started]
    assert [content for content, *_ in told] == [{"prepared by": base.pid}] * 2
    assert [arguments for _, arguments, *_ in told] == [("argument", 0), ("argument", 1)]
    assert [process.pid for _, process in started] == [pid for _, _, pid, _ in told]
    assert len({base.pid, os.getpid(), *(pid for _, _, pid, _ in told)}) == 4
    for connection, process in started:
        assert process.is_alive()
        connection.send("end")
        process.join(5.0)
        assert not process.is_alive()


def test_a_child_is_killed_and_its_connection_then_ends(base):
    connection, process = base.start()
    connection.recv()
    os.kill(process.pid, signal.SIGSTOP)
    process.join(0.05)
    assert process.is_alive()
    process.kill()
    process.join(5.0)
    assert not process.is_alive()
    with pytest.raises(EOFError):
        connection.recv()
    process.kill()  # harmless


def test_children_outlive_the_one_that_forked_them_and_end_with_their_maker(base):
    connection, process = base.start()
    connection.recv()
    base.close()
    connection.send("still there")
    assert connection.recv() == "still there"
    connection.close()
    process.join(5.0)
    assert not process.is_alive()


def test_what_has_threads_is_not_forked():
    base = ForkingProcess(functools.partial(prepare, 1), answer)
    connection, process = base.start()
    with pytest.raises(EOFError):
        connection.recv()
    process.join(5.0)
    assert process.refused
    assert not process.is_alive()
    assert process.pid is None
    base.close()


def test_an_error_in_a_child_ends_it_alone(capfd):
    base = ForkingProcess(prepare, fail)
    _, process = base.start()
    process.join(5.0)
    assert not process.is_alive()
    assert not base.ended
    assert "ZeroDivisionError" in capfd.readouterr().err
    base.close()


def test_a_base_is_shared_by_who_prepares_the_same_and_ends_with_the_last():
    bases = SharedBases()
    (first, one), (again, same), (other, another) = (
        bases.use(functools.partial(prepare, number), answer) for number in (0, 0, 1)
    )
    assert one is same
    assert first == again != other
    assert one.pid != another.pid
    bases.release(first)
    assert not one.ended
    bases.release(again)
    assert one.ended
    bases.release(other)
    assert another.ended


def test_a_base_that_was_killed_is_replaced():
    bases = SharedBases()
    key, base = bases.use(prepare, answer)
    os.kill(base.pid, signal.SIGKILL)
    os.waitid(os.P_PID, base.pid, os.WEXITED | os.WNOWAIT)
    _, following = bases.use(prepare, answer)
    assert following.pid != base.pid
    connection, _ = following.start()
    assert connection.recv()[0] == {"prepared by": following.pid}
    bases.release(key)
    bases.release(key)


def test_what_a_script_defines_itself_is_not_forked():
    assert can_fork_for(functools.partial(prepare, 0))
    own = "from mapctl.runtime.forking import can_fork_for\ndef own(): pass\n"
    script = own + "print(can_fork_for(own), can_fork_for(print))"
    made = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert made.stdout == "False True\n"


def test_ctrl_c_is_not_for_them(base):
    os.kill(base.pid, signal.SIGINT)
    connection, process = base.start()
    connection.recv()
    os.kill(process.pid, signal.SIGINT)
    connection.send("still there")
    assert connection.recv() == "still there"
