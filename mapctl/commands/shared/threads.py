"""How many threads compute. One is fastest: on matrices this small two fight each other."""

import os

_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def use_single_thread() -> None:
    """One thread for torch and BLAS; takes full effect before numpy is first imported."""
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
    import torch

    torch.set_num_threads(1)
