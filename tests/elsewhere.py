"""A device that is none: tensors that say they are elsewhere, and compute on the CPU.

What a GPU would refuse, an operation on tensors of two devices, is written down and then done all the same, so that a
program runs to its end and one run finds all such places. Numbers are the CPU's to the last bit.
"""

from __future__ import annotations

import copy
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

ELSEWHERE = torch.device("meta")  # which needs no driver; nothing here is without numbers
_PACKAGE = Path(__file__).parent.parent / "motionlab"
_aten = torch.ops.aten
#: May take their indices or their source from the CPU.
_ACROSS = (_aten.copy_, _aten._to_copy, _aten.index, _aten.index_put, _aten.index_put_, _aten._index_put_impl_)


class Elsewhere(Tensor):
    """A tensor of that device around one of the CPU."""

    @staticmethod
    def __new__(cls, inner: Tensor):
        return Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=ELSEWHERE, requires_grad=inner.requires_grad,
        )  # fmt: skip

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    def __repr__(self):
        return f"Elsewhere({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _here(func, args, kwargs or {})


def _here(func, args, kwargs):
    """The operation on the CPU's tensors, its results where they belong."""
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    others = [x for x in tensors if not isinstance(x, Elsewhere)]
    there = len(others) < len(tensors)
    if there and any(x.ndim for x in others) and func.overloadpacket not in _ACROSS:  # one number goes along anywhere
        _FOUND.append((_place(), func.overloadpacket.__name__))
    if any(x.is_meta for x in others):
        raise NotImplementedError(f"{func} at {_place()}: a tensor was made elsewhere behind our back")
    asked = kwargs.get("device")
    if asked is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    args_here, kwargs_here = tree_map_only(Elsewhere, lambda x: x.inner, (args, kwargs)) if there else (args, kwargs)
    out = func(*args_here, **kwargs_here)
    if (torch.device(asked) if asked is not None else ELSEWHERE if there else None) != ELSEWHERE:
        return out
    out = tree_map_only(Tensor, lambda x: x if isinstance(x, Elsewhere) else Elsewhere(x), out)
    return return_and_correct_aliasing(func, args, kwargs, out) if there else out


def _place() -> str:
    """The line of the library that is at work."""
    ours = [f for f in traceback.extract_stack() if Path(f.filename).is_relative_to(_PACKAGE)]
    return f"{Path(ours[-1].filename).relative_to(_PACKAGE)}:{ours[-1].lineno}" if ours else "not in the library"


class _Makes(TorchDispatchMode):
    """So that tensors made on that device are there."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _here(func, args, kwargs or {})


class _Asks(TorchFunctionMode):
    """What never asks the dispatcher: lists to tensors and back."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if args and isinstance(args[0], Elsewhere):
            if func in (Tensor.tolist, Tensor.numpy):
                return func(args[0].inner, *args[1:], **kwargs)
            if func is Tensor.new_tensor:
                return Elsewhere(func(args[0].inner, *args[1:], **kwargs))
            if func is Tensor.__getitem__:
                return func(args[0], _indices(args[1]))
            if func is Tensor.__setitem__:
                value = args[2] if isinstance(args[2], Tensor) else torch.tensor(args[2], dtype=args[0].dtype)
                return func(args[0], _indices(args[1]), value)
        if func is torch.tensor and kwargs.get("device") is not None and torch.device(kwargs["device"]) == ELSEWHERE:
            return Elsewhere(func(*args, **kwargs | {"device": "cpu"}))
        return func(*args, **kwargs)


def _indices(index):
    """Lists among indices as tensors of the CPU, which may be an index anywhere."""
    if isinstance(index, tuple):
        return tuple(_indices([*x]) if isinstance(x, (list, tuple)) else x for x in index)
    return torch.tensor(index) if isinstance(index, list) else index


_FOUND: list[tuple[str, str]] = []


@contextmanager
def elsewhere() -> Iterator[list[tuple[str, str]]]:
    """Within, ``ELSEWHERE`` is a device; the list fills with (module:line, operation) where devices are mixed."""
    _FOUND.clear()
    with _Makes(), _Asks():
        yield _FOUND


def moved(thing, move=lambda x: x if isinstance(x, Elsewhere) else Elsewhere(x.detach())):
    """Tensors, and dataclasses, modules, tuples, lists and dictionaries of them, elsewhere, or wherever ``move`` brings
    a tensor."""
    if isinstance(thing, Tensor):
        return move(thing)
    if isinstance(thing, torch.nn.Module):
        found = copy.deepcopy(thing)
        for part in found.modules():
            for table in (part._parameters, part._buffers):
                table.update({name: None if x is None else move(x.detach()) for name, x in table.items()})
        return found
    if isinstance(thing, (list, tuple)):
        each = [moved(x, move) for x in thing]
        return type(thing)(*each) if hasattr(thing, "_fields") else type(thing)(each)
    if isinstance(thing, dict):
        return {name: moved(x, move) for name, x in thing.items()}
    if hasattr(thing, "__dataclass_fields__"):
        return type(thing)(**{name: moved(getattr(thing, name), move) for name in thing.__dataclass_fields__})
    return thing
