"""Where a network is trained: on the processor, or on a GPU that is there."""

import os

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
