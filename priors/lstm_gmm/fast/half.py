"""Weights in half precision that kernels read as single precision, on processors that convert them as they load.

A weight of 16 bits is read from memory twice as fast as one of 32, and a rollout of one particle is a matter of memory
bandwidth. Nothing is rounded: only networks whose weights are half-precision numbers already, as those of bundled files
are, are packed this way.
"""

import platform
from collections.abc import Sequence
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic


def _type_widening(typing_context: Any, value: Any) -> Any:
    if value == types.float32:
        return types.float32(types.float32), lambda context, builder, signature, given: given[0]
    if value == types.uint16:
        return types.float32(types.uint16), _convert_half
    return None


def _convert_half(context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
    return builder.fpext(builder.bitcast(given[0], ir.HalfType()), ir.FloatType())


widen: Any = intrinsic(_type_widening)
"""For kernels: a weight as float32, from float32 or from the bits (uint16) of a half-precision number."""


def converts_half() -> bool:
    """Return whether the processor that kernels are compiled for converts half precision by an instruction."""
    settings: Any = config
    if settings.CPU_NAME == "generic":
        return False
    if platform.machine().lower() in ("arm64", "aarch64"):
        return True
    if settings.CPU_FEATURES is not None:
        return "+f16c" in settings.CPU_FEATURES
    return bool(llvm.get_host_cpu_features().get("f16c", False))


def is_half(weights: np.ndarray) -> bool:
    """Return whether half precision holds every weight exactly."""
    with np.errstate(over="ignore"):
        return bool(np.array_equal(weights.astype(np.float16).astype(np.float32), weights))


def to_half_bits(weights: np.ndarray) -> np.ndarray:
    """Return the bits (uint16) of the weights in half precision."""
    return weights.astype(np.float16).view(np.uint16)
