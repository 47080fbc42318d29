"""Where training computes: on processors, or on a GPU with CUDA.

Inside `use_device` that is torch's default device, so what training makes is made there without being told: windows,
networks, random numbers.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

from mapctl.errors import RequestError
from priors.training.parallel import count_launched


def select_device(wanted: str) -> str:
    """The device of `auto`, `cpu` or `cuda`; RequestError for one that this process cannot have."""
    if wanted not in ("auto", "cpu", "cuda"):
        raise RequestError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise RequestError("this machine has no CUDA device; use --device cpu")
    local, devices = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
    if wanted != "cpu" and devices and count_launched() is not None and local >= devices:
        raise RequestError(f"this machine has {devices} CUDA devices, too few for process {local}; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


def refuse_gpu(wanted: str, kind: str) -> None:
    """RequestError where a GPU is asked for a model that none makes faster."""
    if wanted == "cuda":
        raise RequestError(f"a {kind} is not trained on GPUs; use --device cpu")


def check_processes(device: str, processes: int, kind: str) -> None:
    """RequestError for several processes on a GPU that torchrun has not started: what CUDA runs in cannot be forked."""
    if device == "cuda" and processes > 1 and count_launched() is None:
        raise RequestError(
            "several processes on GPUs are started by torchrun, one a GPU: python -m torch.distributed.run"
            f" --nproc-per-node {processes} -m mapctl train {kind} ...; or use --device cpu"
        )


@contextmanager
def use_device(name: str) -> Iterator[None]:
    """Make tensors there that are not told where."""
    if torch.get_default_device().type == torch.device(name).type:
        yield  # as it is: a default of torch's costs each of its calls a little
        return
    with torch.device(name):
        yield


@cache
def has_bfloat16() -> bool:
    """Whether the processor computes in bfloat16: one that does not may refuse an LSTM, and is slower than in
    float32."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # younger versions of torch have it
    if capabilities.get("architecture") == "x86_64":
        return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "avx_ne_convert"))
    network, sequence = torch.nn.LSTM(8, 8, device="cpu"), torch.zeros(2, 1, 8, device="cpu")
    try:
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            network(sequence)
    except RuntimeError:
        return False
    return True


def find_precision(settings: object) -> str:
    """`bfloat16` or `float32`, as the settings of a training say, if they do."""
    return "bfloat16" if getattr(settings, "bfloat16", False) else "float32"


def make_generator(seed: int) -> torch.Generator:
    """Make a generator that draws on the device in use."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)
