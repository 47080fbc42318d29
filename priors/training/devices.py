"""Where training computes: on processors, or on a GPU with CUDA.

Inside `use_device` that is torch's default device, so that windows, networks and random numbers are made there.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mapctl.errors import RequestError


def select_device(wanted: str) -> str:
    """Return the device of `auto`, `cpu` or `cuda`; RequestError where this machine has none."""
    if wanted not in ("auto", "cpu", "cuda"):
        raise RequestError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise RequestError("this machine has no CUDA device; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


@contextmanager
def use_device(name: str) -> Iterator[None]:
    """Make tensors on this device unless another is given."""
    if torch.get_default_device().type == torch.device(name).type:
        yield  # as it is: a default of torch's costs each of its calls a little
        return
    with torch.device(name):
        yield


def make_generator(seed: int) -> torch.Generator:
    """Make a generator that draws on the device in use."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)
