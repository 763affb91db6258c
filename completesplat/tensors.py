"""Frozen dataclasses of tensors, which are moved between devices, batched and indexed together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree
from torch.utils.data import default_collate

T = TypeVar("T", bound="TensorDataclass")


@contextmanager
def in_float32() -> Iterator[None]:
    """Make float32, in which networks and cameras compute, torch's default type in the block or decorated function."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def used_device() -> str:
    """Return where networks compute: "cuda", or else "mps", if torch has one, else "cpu"."""
    if torch.cuda.is_available():
        return "cuda"
    return "mps" if torch.backends.mps.is_available() else "cpu"


def as_float64(tensor: Tensor) -> Tensor:
    """Return a tensor in float64, on the CPU if it was on Apple's MPS, which has no float64."""
    return (tensor.cpu() if tensor.device.type == "mps" else tensor).double()


@dataclass(frozen=True)
class TensorDataclass:
    """Base of the frozen dataclasses whose fields are tensors, nested tensor dataclasses, or static values.

    Static values (image sizes, names, None) are carried along unchanged. A TypeVar stands for `typing.Self`, which
    beartype's import hook does not accept here.
    """

    def __init_subclass__(cls) -> None:
        """Let torch look into a subclass where it takes nested values, as the outputs of `torch.export`."""
        super().__init_subclass__()
        _pytree.register_pytree_node(cls, _parts, partial(_rebuilt, cls))

    def map(self: T, function: Callable[[Tensor], Tensor]) -> T:
        """Return the same dataclass with `function` applied to every tensor, including nested ones."""

        def apply(value: object) -> object:
            if isinstance(value, Tensor):
                return function(value)
            return value.map(function) if isinstance(value, TensorDataclass) else value

        return replace(self, **{field.name: apply(getattr(self, field.name)) for field in fields(self)})

    def to(self: T, *args: Any, **kwargs: Any) -> T:
        """Move every tensor to a device or dtype, with the arguments of `torch.Tensor.to`.

        Integer and boolean tensors keep their dtype. Copies to a GPU do not block. (Lightning asks for that only if a
        batch is a plain tensor.)
        """
        device, dtype, non_blocking, _ = torch._C._nn._parse_to(*args, **kwargs)
        non_blocking = non_blocking or (device is not None and device.type == "cuda")
        return self.map(lambda x: x.to(device, dtype if x.is_floating_point() else x.dtype, non_blocking))

    def pin_memory(self: T) -> T:
        """Copy every tensor into page-locked memory (called by `torch.utils.data.DataLoader`)."""
        return self.map(lambda tensor: tensor.pin_memory())

    def repeated(self: T, count: int) -> T:
        """Return the same `count` times along a new leading axis, without copies in memory."""
        return self.map(lambda tensor: tensor.expand(count, *tensor.shape))

    def detach(self: T) -> T:
        """Cut every tensor off the autograd graph."""
        return self.map(torch.Tensor.detach)

    def __getitem__(self: T, index: Any) -> T:
        """Index the leading batch axes of every tensor alike, and texts (such as names) that `stack` has collected."""

        def select(value: Any) -> object:
            texts = isinstance(value, tuple) and all(isinstance(part, str) for part in value)
            return value[index] if texts or isinstance(value, Tensor | TensorDataclass) else value

        return replace(self, **{field.name: select(getattr(self, field.name)) for field in fields(self)})


Statics = tuple[tuple[str, object], ...]


def _parts(value: TensorDataclass) -> tuple[list[object], tuple[tuple[str, ...], Statics]]:
    """Return the tensors and nested dataclasses, and their names with the static values."""
    values = {field.name: getattr(value, field.name) for field in fields(value)}
    names = tuple(name for name, part in values.items() if isinstance(part, Tensor | TensorDataclass))
    return [values[name] for name in names], (names, tuple((n, part) for n, part in values.items() if n not in names))


def _rebuilt(kind: type[T], parts: Iterable[object], context: tuple[tuple[str, ...], Statics]) -> T:
    """Return a dataclass of parts that need not be tensors: torch also puts placeholders in their place."""
    names, statics = context
    made = object.__new__(kind)
    for name, part in (*zip(names, parts, strict=True), *statics):
        object.__setattr__(made, name, part)
    return made


def stack(items: Sequence[T]) -> T:
    """Stack equal-shaped dataclasses along a new leading axis (the collate function of the data loaders).

    Strings are collected into a tuple. Other static values must be the same in all items.

    Raises:
        ValueError: there are no items, or a static value differs between them.
    """
    if not items:
        raise ValueError("cannot stack an empty sequence")
    merged = {}
    for field in fields(items[0]):
        merged[field.name] = _merge([getattr(item, field.name) for item in items])
    return replace(items[0], **merged)


def concatenate(items: Sequence[T], axis: int = 0) -> T:
    """Concatenate the items' tensors along an existing axis, and take static values from the first item."""

    def join(values: list[Any]) -> object:
        if isinstance(values[0], Tensor):
            return torch.cat(values, dim=axis)
        return concatenate(values, axis) if isinstance(values[0], TensorDataclass) else values[0]

    joined = {}
    for field in fields(items[0]):
        joined[field.name] = join([getattr(item, field.name) for item in items])
    return replace(items[0], **joined)


def _merge(values: list[Any]) -> object:
    first = values[0]
    if isinstance(first, Tensor):
        # Like `torch.stack`, but a loader's worker process writes directly into memory that it shares with training.
        return default_collate(values)
    if isinstance(first, TensorDataclass):
        return stack(values)
    if isinstance(first, str):
        return tuple(values)
    if any(value != first for value in values):
        raise ValueError(f"static values differ between the items of a batch: {values}")
    return first
