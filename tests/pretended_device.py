"""A device that is not there: its tensors lie on the processor, say that they do not, and refuse to meet those that do.

What runs on it runs on a GPU as far as places of tensors go: one that was made on the processor by mistake is an error
here as it is there. Tensors of one number may meet any, and those of the processor may index, as CUDA has it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "lazy:0"  # a kind of device for which torch's graph needs nothing that this build lacks
_THERE, _HERE = torch.device(NAME), torch.device("cpu")
_ATEN: Any = torch.ops.aten
_CROSSING = {_ATEN._to_copy.default, _ATEN.copy_.default, _ATEN.copy.default}
_INDEXING = {_ATEN.index.Tensor, _ATEN.index_put.default, _ATEN.index_put_.default, _ATEN._index_put_impl_.default}


class FarTensor(torch.Tensor):
    """A tensor of that device."""

    held: torch.Tensor
    """Its numbers."""

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "FarTensor":
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), dtype=held.dtype, device=_THERE
        )
        made.held = held
        return made

    def __init__(self, held: torch.Tensor):
        pass

    def tolist(self) -> Any:
        return self.held.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("a tensor of another device has no array")

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(function, args, kwargs or {})


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(function, args, kwargs or {})


class _Lists(TorchFunctionMode):
    """What torch makes of lists behind the back of a dispatch mode."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function in (torch.tensor, torch.as_tensor):
            if isinstance(args[0], torch.Tensor):
                return args[0].to(kwargs.get("dtype", args[0].dtype))
            made = function(*args, **{**kwargs, "device": _HERE})
            return made if torch.device(kwargs.get("device") or _THERE) == _HERE else made.to(_THERE)
        if function is torch.Tensor.new_tensor and isinstance(args[0], FarTensor):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **kwargs, "device": _HERE}).to(_THERE)
        if function in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            args = (args[0], _tabulate(args[1]), *args[2:])
        return function(*args, **kwargs)


@contextmanager
def pretend_device() -> Iterator[None]:
    """Make tensors on that device that are not told where."""
    with _Operations(), _Lists(), _THERE:
        yield


@contextmanager
def replace_gpu(patch: pytest.MonkeyPatch, *modules: Any) -> Iterator[None]:
    """Let training select that device; `modules` are all that use one by name. Random numbers are the processor's."""
    generator, autocast = torch.Generator, torch.autocast

    @contextmanager
    def use(name: str) -> Iterator[None]:
        with pretend_device() if torch.device(name).type == _THERE.type else torch.device(name):
            yield

    class Generator:  # a class, since signatures name it
        def __new__(cls, device: Any = None) -> Any:
            return generator()

    def cast(kind: str, *args: Any, **kwargs: Any) -> Any:
        return nullcontext() if kind == _THERE.type else autocast(kind, *args, **kwargs)

    for module in modules:
        patch.setattr(module, "use_device", use)
    patch.setattr(torch, "Generator", Generator)
    patch.setattr(torch, "autocast", cast)
    yield


def _compute(function: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, dict(kwargs))) if isinstance(leaf, torch.Tensor)]
    far = [tensor for tensor in tensors if isinstance(tensor, FarTensor)]
    near = [tensor for tensor in tensors if not isinstance(tensor, FarTensor) and tensor.dim()]
    asked = kwargs.get("device")
    if far and near and function not in _CROSSING and not _may_index(function, args):
        raise RuntimeError(f"{function}: tensors of two devices, {[tuple(one.shape) for one in near]} are here")
    there = bool(far) if asked is None else torch.device(asked).type == _THERE.type
    there = there and function is not _ATEN._local_scalar_dense.default
    if function is _ATEN.copy_.default:
        there = isinstance(args[0], FarTensor)
    own = {name: _HERE if name == "device" and value is not None else value for name, value in kwargs.items()}
    found = function(*tree_map(_unwrap, tuple(args)), **tree_map(_unwrap, own))
    if function._schema.is_mutable:
        return args[0] if isinstance(args[0], FarTensor) else found
    return tree_map(_wrap, found) if there else found


def _may_index(function: Callable[..., Any], args: Sequence[Any]) -> bool:
    """Whether only indices are of the processor."""
    if function not in _INDEXING or not isinstance(args[0], FarTensor):
        return False
    return len(args) < 3 or isinstance(args[2], FarTensor) or args[2].dim() == 0


def _tabulate(index: Any) -> Any:
    if isinstance(index, tuple):
        return tuple(_tabulate(each) for each in index)
    if not isinstance(index, list):
        return index
    return torch.tensor(index, dtype=None if index else torch.long, device=_HERE)


def _unwrap(value: Any) -> Any:
    return value.held if isinstance(value, FarTensor) else value


def _wrap(value: Any) -> Any:
    return FarTensor(value) if isinstance(value, torch.Tensor) and not isinstance(value, FarTensor) else value
