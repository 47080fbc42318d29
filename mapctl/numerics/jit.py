"""How numba kernels are compiled: kept on disk where that can be, one core, no Python objects inside."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit

JitDecorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def make_jit_decorators(*relaxed: str) -> tuple[JitDecorator, JitDecorator]:
    """Make (entry, inner): decorators for functions that Python calls, and for those that only compiled code calls.

    `relaxed` names LLVM's fast-math flags; NaN and infinity keep their meaning while `nnan` and `ninf` are not among
    them. Inner functions go without the wrappers for Python, which makes the first use quicker.
    """
    shared: dict[str, Any] = {"error_model": "numpy", "fastmath": set(relaxed)}

    def entry(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return _tolerate_full_disk(_njit(cache=True, nogil=True, **shared)(function))
        except RuntimeError:  # numba found no folder that it may write to
            return _njit(nogil=True, **shared)(function)

    return entry, _njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **shared)


def _tolerate_full_disk(compiled: Any) -> Any:
    """Ignore a full disk where numba keeps compiled code: the next start takes longer, nothing fails."""
    cache = compiled._cache
    keep = cache.save_overload

    def keep_if_possible(*overload: Any) -> None:
        with suppress(OSError):
            keep(*overload)

    cache.save_overload = keep_if_possible
    return compiled


def _njit(**options: Any) -> JitDecorator:
    """Return numba's decorator, whose overloads no type checker follows."""
    compiler: Any = njit
    return compiler(**options)
