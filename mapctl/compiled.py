"""How the core's numba kernels are compiled: kept on disk where that can be, one core, no Python objects inside."""

from numba import njit

# Sums may be fused; NaN and infinity keep their meaning.
_RELAXED = {"contract", "nsz"}


def entry(function):
    """Compile a function that Python calls, and all that it calls."""
    options = {"error_model": "numpy", "fastmath": _RELAXED, "nogil": True}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder that it may write to
        return njit(**options)(function)


# Called from compiled code only: leaving the wrappers for Python out makes the first use quicker.
_INNER = {"error_model": "numpy", "fastmath": _RELAXED, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
inner = njit(**_INNER)
"""Compile a function that only compiled code calls."""
