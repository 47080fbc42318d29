"""Test session: one thread, and every shape annotation of the project executed."""

import os

# Before numpy or torch is imported: BLAS reads these once.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

from collections.abc import Iterator
from functools import partial, wraps
from inspect import isclass, isfunction, isgeneratorfunction
from pathlib import Path
from typing import ForwardRef, get_args

import hypothesis
import jaxtyping
import pytest
import torch
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, TypeCheckError, install_import_hook

torch.set_num_threads(1)
# A machine whose other cores are busy is no failure.
hypothesis.settings.register_profile("mapctl", deadline=None)
hypothesis.settings.load_profile("mapctl")

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("mapctl", "priors", "controllers", "scenes")

# An int where a float is requested is fine, as PEP 484 says. One error for all that does not fit, a TypeError.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeCheckError))


def _parts(hint) -> Iterator:
    """An annotation and all that it is made of."""
    yield hint
    for part in hint if isinstance(hint, list) else get_args(hint):  # a list: the arguments of a Callable
        yield from _parts(part)


def _jaxtyped(whole, function=None, *, typechecker):
    """jaxtyping's decorator at a fraction of its cost: it would check arguments before a call and again after it.

    Here beartype checks once, within a scope of jaxtyping for the dimensions, and alone where no shape is given. Two
    kinds are left to jaxtyping: names in quotes, since it passes over those that exist for type checkers alone, and
    generators, which beartype checks when they begin, outside of their scope.
    """
    if function is None:
        return partial(_jaxtyped, whole, typechecker=typechecker)
    hints = [part for hint in getattr(function, "__annotations__", {}).values() for part in _parts(hint)]
    quoted = any(isinstance(hint, str | ForwardRef) for hint in hints)
    if not isfunction(function) or isgeneratorfunction(function) or quoted:
        return whole(function, typechecker=typechecker)
    once = typechecker(function)
    shapes = any(isclass(hint) and issubclass(hint, AbstractArray) for hint in hints)
    return _scoped(whole, once) if shapes else once


def _scoped(whole, function):
    """The function within a scope for dimensions, without the binding of arguments that jaxtyping's wrapper does."""

    @wraps(function)
    def called(*positional, **named):
        with whole("context"):
            return function(*positional, **named)

    return called


def _annotated_modules() -> list[str]:
    """Every module but those with numba kernels: numba compiles the plain function, not a wrapped one."""
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    plain = [file for file in files if file.name != "__init__.py" and "numba" not in file.read_text("utf-8")]
    return [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in plain]


jaxtyping.jaxtyped = partial(_jaxtyped, jaxtyping.jaxtyped)
install_import_hook(_annotated_modules(), "conftest.checked")


# Their modules are imported late: the hook above must come first.
@pytest.fixture(scope="session")
def prior(tmp_path_factory) -> str:
    """A tiny density, for --prior."""
    from tiny_prior import save_tiny_prior

    return str(save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors"))


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """A folder of five walks to train on; no test changes it."""
    from helpers import write_corpus

    return write_corpus(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def small_judgements() -> Iterator[None]:
    """Models in training are judged in a moment, on few windows, where a test is not about how well they do."""
    from priors.training import critics, gaps
    from priors.training.recipes import lstm_gmm, pose_transformer, refiner, stitcher

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lstm_gmm, "measure_free_runs", partial(lstm_gmm.measure_free_runs, runs=2, frames=20))
        patch.setattr(gaps, "_WINDOWS", 2)
        patch.setattr(pose_transformer, "_CALIBRATED_WINDOWS", 4)
        small = {"_WARM_UP": 1, "_HEAD_START": 1, "_SAMPLES": 6, "_JUDGED": 2, "_SECONDS": 1.2}
        patch.setattr(critics, "_END_WIDTH", 6)
        for name, value in small.items():
            patch.setattr(refiner, name, value)
        patch.setattr(stitcher, "_WINDOWS", 4)
        patch.setattr(stitcher, "_DRAWS", 2)
        patch.setattr(stitcher, "TEMPERATURES", (0.5, 1.0, 2.0))
        yield


@pytest.fixture
def actors() -> list:
    """Two characters that note their commands."""
    from stage import Actor

    return [Actor(), Actor()]


@pytest.fixture
def show(actors) -> Iterator:
    """The live viewer with those two on its stage; it has to close both."""
    from stage import live_app

    with live_app(actors) as result:
        yield result
    assert all(actor.heard[-1] == ("close",) for actor in actors)


@pytest.fixture
def fails(tmp_path, capsys, monkeypatch):
    """Runs mapctl in an empty folder and holds it to the rule: exit status 2, one line on standard error, nothing
    written. Returns the line.
    """
    from helpers import run

    monkeypatch.chdir(tmp_path)

    def check(*words: object) -> str:
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        status = run(*words)
        printed = capsys.readouterr()
        assert status == 2
        assert printed.out == ""
        assert printed.err.startswith("mapctl: ")
        assert printed.err.count("\n") == 1
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
        return printed.err

    return check


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files whose processes take longest: the last file that a worker takes, it takes alone."""
    items.sort(key=lambda item: "steering_live" not in item.nodeid)
