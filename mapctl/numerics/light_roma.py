"""roma without torch's compiler, which takes a second to import.

roma asks for `torch._dynamo` while it is imported, to exempt its Procrustes functions from being compiled; they are not
used here. Where the compiler is not there yet, a stand-in answers.
"""

import sys
from types import SimpleNamespace

import torch

if "torch._dynamo" in sys.modules:
    import roma
else:
    torch._dynamo = SimpleNamespace(disable=lambda function: function)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        import roma
    finally:
        del torch._dynamo

__all__ = ["roma"]
