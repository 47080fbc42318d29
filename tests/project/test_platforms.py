"""mapctl without what only some systems have (docs/guides/platforms.md): each call has a way round, and that is taken.

Another system is played in a process of its own: what it lacks is taken from Python before mapctl is imported. This
shows that nothing here asks for it; it does not show that the other system works.
"""

import ast
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pages
import pytest
from helpers import walk
from source_files import PACKAGE_FILES, ROOT, tree_of

from mapctl.commands.shared import inputs
from mapctl.commands.train.whole_set.plan import CACHE, Job
from mapctl.errors import RequestError, WriteError
from mapctl.formats import atomic
from mapctl.isolated import child
from mapctl.runtime import forking, interruption
from priors.training import parallel
from priors.training.bundled.models import list_models
from scenes.renderers import offscreen, select

PAGE = "docs/guides/platforms.md"
POSIX_MODULES = {"fcntl", "grp", "pwd", "resource", "termios"}
THIRD_PARTIES = (
    *("joblib", "multiprocessing.popen_spawn_posix", "numba", "numpy", "rich.console", "scipy.optimize", "torch"),
    *("torch.distributed", "tyro", "viser", "av", "matplotlib.figure", "PIL.Image"),
)
PLAY = f"""
import asyncio, concurrent.futures.process, contextlib, importlib, os, platform, signal, subprocess, sys
for name in {THIRD_PARTIES!r}:  # what they do on other systems is theirs
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {POSIX_MODULES!r}:
            raise ModuleNotFoundError(name, name=name)
for name in {POSIX_MODULES!r}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Missing())
for name in "SIGHUP SIGKILL SIGUSR1 pthread_sigmask".split():
    delattr(signal, name)
for name in "fork getuid getpgid killpg sysconf wait4 waitpid WNOHANG mkfifo sched_getaffinity".split():
    delattr(os, name)
sys.platform = PLATFORM
"""
IMPORT_ALL = f"""
for name in {[".".join(file.with_suffix("").parts).removesuffix(".__init__") for file in PACKAGE_FILES]!r}:
    if not name.startswith("mapctl.blender.addon") and not name.endswith(".__main__"):
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            assert error.name in ("av", "pxr", "ufbx", "pythonosc", "viser", "matplotlib", "PIL"), (name, error)
from mapctl.runtime import forking
assert not forking.AVAILABLE
"""


def play(script: str, platform: str, cwd: Path) -> str:
    """Standard output of a process on a played system."""
    code = PLAY.replace("PLATFORM", repr(platform)) + script
    done = subprocess.run([sys.executable, "-c", code], cwd=cwd, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def environment() -> dict[str, str]:
    """This process's, in which the checkout is found."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_all_modules_are_imported_without_what_a_system_lacks(platform, tmp_path):
    play(IMPORT_ALL, platform, tmp_path)


@pytest.mark.slow
def test_a_command_runs_without_it(tmp_path):
    walk(40).save(tmp_path / "walk.bvh")
    words = ["convert", "walk.bvh", "mirrored.npz", "--mirror"]
    play(f"from mapctl.cli import main\nassert main({words!r}) == 0", "win32", tmp_path)
    assert (tmp_path / "mirrored.npz").is_file()


CALLS = {
    *("fork", "getrusage", "setrlimit", "sysconf", "killpg", "getpgid", "waitpid", "flock", "chmod", "pthread_sigmask"),
    *("symlink_to", "sched_getaffinity", "getuid", "mkfifo", "send_handle", "recv_handle"),
    *("SIGHUP", "SIGKILL", "SIGUSR1", "WNOHANG", "pass_fds", "start_new_session"),
}
"""What not every system has, as calls, names or options."""


def posix_calls(tree: ast.Module) -> set[str]:
    """What a file asks of a POSIX system."""
    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(attr=name) if name in CALLS or ast.unparse(node) == "os.kill":
                found.add(name)
            case ast.keyword(arg=str(name)) if name in CALLS:
                found.add(name)
            case ast.Constant(value=str(text)) if text.startswith("/proc/"):
                found.add("/proc")
    return found


@pytest.mark.slow
def test_what_some_systems_lack_is_on_the_page():
    page = pages.read_page(PAGE)
    lists = {str(file): posix_calls(tree_of(file)) for file in PACKAGE_FILES}
    users = {file: calls for file, calls in lists.items() if calls}
    assert len(users) > 5
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for file, calls in users.items():
        told = " ".join(row for row in rows if f"`{file}`" in row)
        assert {call for call in calls - {"WNOHANG", "recv_handle"} if call not in told} == set(), file


def test_files_on_the_page_are_there():
    named = re.findall(r"`((?:mapctl|priors|scenes|controllers)/[\w/]+\.py)`", pages.read_page(PAGE))
    assert len(named) > 8
    assert [file for file in named if not (ROOT / file).is_file()] == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import os\nos.fork()", {"fork"}),
        ("os.kill(1, signal.SIGKILL)", {"kill", "SIGKILL"}),
        ("process.kill()", set()),
        ("Popen(words, pass_fds=[3])", {"pass_fds"}),
        ("Path(f'/proc/{pid}/stat')", {"/proc"}),
    ],
)
def test_calls_are_seen(source, found):
    assert posix_calls(ast.parse(source)) == found


def test_a_reader_without_bounds_on_memory_reads(monkeypatch):
    """macOS refuses some limits."""
    asked = []

    def refuse(what, limit):
        asked.append(what)
        raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr(child, "resource", SimpleNamespace(RLIMIT_AS=1, RLIMIT_CORE=2, setrlimit=refuse))
    child._bound_memory(1 << 30)
    assert asked == [1, 2]


def test_a_signal_that_is_sent_again_does_not_end_a_process_of_windows(monkeypatch):
    heard = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        monkeypatch.setattr(interruption, "os", SimpleNamespace(name="nt", kill=lambda *_: pytest.fail("it ends here")))
        interruption._send_again(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [signal.SIGINT]


@pytest.mark.timeout(20)
def test_a_drive_that_is_not_there_is_no_folder(monkeypatch):
    monkeypatch.setattr(Path, "exists", lambda path: False)
    monkeypatch.setattr(Path, "is_dir", lambda path: False)
    with pytest.raises(WriteError, match="is not a folder"):
        atomic.check_folder("/out/deeper")


def test_a_missing_curve_is_no_shape_whichever_way_its_path_is_written(monkeypatch):
    monkeypatch.setattr(inputs, "os", SimpleNamespace(sep="\\", altsep="/"))
    with pytest.raises(RequestError, match="nowhere/circle: no such file"):
        inputs.read_curve("nowhere/circle", None)


def test_models_are_trained_without_links(tmp_path, monkeypatch):
    def refuse(*words, **options):
        raise OSError("a required privilege is not held by the client")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    job = Job(list_models()[0], tmp_path / "run", ("mapctl", "train"))
    assert job.resume() == ["mapctl", "train"]
    assert not (tmp_path / "run" / CACHE).exists()


def test_training_in_several_processes_names_torchrun_where_none_are_forked(monkeypatch):
    monkeypatch.setattr(forking, "AVAILABLE", False)
    with pytest.raises(RequestError, match="torchrun"), parallel.fork_group(2, lambda group: None):
        pass


@pytest.mark.slow
def test_without_egl_a_window_is_opened_and_its_errors_are_no_crash(monkeypatch, caplog):
    class NoDisplayError(Exception):
        pass

    def open_window(width, height):
        assert "PYOPENGL_PLATFORM" not in os.environ
        raise NoDisplayError("no display")

    monkeypatch.setattr(offscreen, "NEEDS_NO_SCREEN", False)
    monkeypatch.setattr(select, "NEEDS_NO_SCREEN", False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.delenv(select.RENDERER_VARIABLE, raising=False)
    monkeypatch.setitem(sys.modules, "pyrender", SimpleNamespace(OffscreenRenderer=open_window))
    offscreen._open_graphics.cache_clear()
    try:
        assert select.select_painter().name.startswith("matplotlib")
    finally:
        offscreen._open_graphics.cache_clear()
    assert "no display" in caplog.text
    assert "a screen is needed" in caplog.text


def test_letters_that_the_output_cannot_hold_are_replaced(tmp_path):
    words = [sys.executable, "-m", "mapctl", "--help"]
    plain = {**environment(), "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, cwd=tmp_path, env=plain, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "follow" in done.stdout
