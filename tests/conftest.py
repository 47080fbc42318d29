"""Test session: one thread, and every shape annotation of the project executed."""

import os

# Before numpy or torch is imported: BLAS reads these once.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

from pathlib import Path

import pytest
import torch
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

torch.set_num_threads(1)

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("mapctl", "priors", "controllers", "scenes")

# An int where a float is asked for is fine, as PEP 484 says.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))


def _annotated_modules() -> list[str]:
    """Every module but those with numba kernels: numba compiles the plain function, not a wrapped one."""
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    plain = [file for file in files if file.name != "__init__.py" and "numba" not in file.read_text("utf-8")]
    return [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in plain]


install_import_hook(_annotated_modules(), "conftest.checked")


# Their modules are imported late: the hook above must come first.
@pytest.fixture(scope="session")
def prior(tmp_path_factory) -> str:
    """A tiny density, for --prior."""
    from tiny_prior import save_tiny_prior

    return str(save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors"))


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """A folder of five walks to train on; no test changes it."""
    from helpers import write_corpus

    return write_corpus(tmp_path_factory.mktemp("data"))
