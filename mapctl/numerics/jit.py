"""How numba kernels are compiled: kept on disk where that can be, on one core, without Python objects inside."""

from collections.abc import Callable
from typing import Any

from numba import njit

JitDecorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def make_jit_decorators(*relaxed: str) -> tuple[JitDecorator, JitDecorator]:
    """Make (entry, inner): decorators for functions that Python calls, and for those that only compiled code calls.

    `relaxed` names LLVM's fast-math flags; NaN and infinity keep their meaning while `nnan` and `ninf` are not among
    them. Inner functions go without the wrappers for Python, which makes the first use quicker.
    """
    compiler: Any = njit  # whose overloads no type checker follows
    shared: dict[str, Any] = {"error_model": "numpy", "fastmath": set(relaxed)}

    def entry(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return compiler(nogil=True, cache=True, **shared)(function)
        except RuntimeError:  # numba found no folder that it may write to: each process compiles
            return compiler(nogil=True, **shared)(function)

    return entry, compiler(no_cpython_wrapper=True, no_cfunc_wrapper=True, **shared)
