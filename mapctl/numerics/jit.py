"""How numba kernels are compiled: kept on disk where that can be, one core, no Python objects inside."""

from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache, NullCache
from numba.core.runtime import rtsys

from mapctl.numerics import compilation

JitDecorator = Callable[[Callable[..., Any]], Callable[..., Any]]

_kernels: list["KernelCache | NoKernelCache"] = []  # of those that Python calls
_first_uses = count(1)


def make_jit_decorators(*relaxed: str) -> tuple[JitDecorator, JitDecorator]:
    """Make (entry, inner): decorators for functions that Python calls, and for those that only compiled code calls.

    `relaxed` names LLVM's fast-math flags; NaN and infinity keep their meaning while `nnan` and `ninf` are not among
    them. Inner functions go without the wrappers for Python, which makes the first use quicker.
    """
    shared: dict[str, Any] = {"error_model": "numpy", "fastmath": set(relaxed)}

    def entry(function: Callable[..., Any]) -> Callable[..., Any]:
        compiled: Any = _njit(nogil=True, **shared)(function)
        try:
            compiled._cache = KernelCache(function)
        except RuntimeError:  # numba found no folder that it may write to
            compiled._cache = NoKernelCache()
        _kernels.append(compiled._cache)
        return compiled

    return entry, _njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **shared)


def find_folders() -> set[str]:
    """Find the folders on disk in which kernels of the imported modules are kept; none where nothing may be written."""
    return {kernel.cache_path for kernel in _kernels if kernel.cache_path is not None}


class KernelCache(FunctionCache):
    """Compiled kernels on disk, which load without numba's compiler.

    numba would import all of the compiler first, and scipy's linear algebra with it: a quarter of a second, of which a
    kernel that is ready needs the memory manager alone. What is compiled after all gets the rest from the compiler
    itself. A full disk and damaged files are ignored: the next start takes longer, nothing fails.
    """

    _number = 0  # of the kernel that is compiled

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature, None where it must be compiled."""
        rtsys.initialize(target_context)
        try:
            found = self._load_overload(sig, target_context)
        except Exception:  # a damaged file leads to whatever unpickling it leads to
            found = None
            with suppress(OSError):
                self.flush()
        self._number = next(_first_uses)
        if found is None:
            _announce(self._number, begins=True)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled."""
        with suppress(OSError):
            super().save_overload(sig, data)
        _announce(self._number, begins=False)


class NoKernelCache(NullCache):
    """Kernels that can be kept nowhere: each process compiles them, and says so."""

    _number = 0

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Return nothing."""
        self._number = next(_first_uses)
        _announce(self._number, begins=True)

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep nothing."""
        _announce(self._number, begins=False)


def _announce(number: int, *, begins: bool) -> None:
    compilation.announce(number, len(_kernels), begins=begins)


def _njit(**options: Any) -> JitDecorator:
    """Return numba's decorator, whose overloads no type checker follows."""
    compiler: Any = njit
    return compiler(**options)
