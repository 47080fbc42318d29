"""Tensors into a safetensors file, whole or not at all."""

import os
import re
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from mapctl.formats.atomic import atomic_path

_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a file that appears whole or not at all; RequestError where it cannot be written, as on a full disk."""
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as scratch:
        try:
            save_file(contiguous, scratch, metadata=dict(metadata) if metadata else None)
        except SafetensorError as error:
            # The library's own kind of error, which says in words what the system's says by number.
            found = _SYSTEM_ERROR.search(str(error))
            raise OSError(int(found[1]), os.strerror(int(found[1]))) if found else OSError(str(error)) from error
