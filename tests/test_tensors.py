"""Tensor dataclasses: dtypes, nesting, collation, and the ways in which torch and Lightning handle them."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor
from torch.utils.data import DataLoader

from completesplat.tensors import TensorDataclass, stack


@dataclass(frozen=True)
class Inner(TensorDataclass):
    values: Tensor
    size: tuple[int, int] = (4, 6)


@dataclass(frozen=True)
class Outer(TensorDataclass):
    floats: Tensor
    integers: Tensor
    flags: Tensor
    inner: Inner
    name: str | tuple[str, ...] = "a"
    note: Any = None


def make(index: int = 0) -> Outer:
    floats = torch.arange(6.0).reshape(2, 3) + index
    integers = torch.arange(2) + 2**40 + index
    inner = Inner(torch.full((2, 5), float(index)))
    return Outer(floats, integers, torch.tensor([True, False]), inner, f"scene{index}")


def tensors(item: Outer) -> list[Tensor]:
    return [item.floats, item.integers, item.flags, item.inner.values]


@pytest.mark.parametrize(
    ("args", "kwargs"),
    [
        ((torch.float64,), {}),
        (("cpu",), {"dtype": torch.float64}),
        ((torch.zeros(1, dtype=torch.float64),), {}),
        ((), {"dtype": torch.float64, "non_blocking": True}),
    ],
)
def test_to_casts_only_floats_in_every_form_of_the_call(args: tuple, kwargs: dict) -> None:
    item = make(3)
    moved = item.to(*args, **kwargs)
    assert [tensor.dtype for tensor in tensors(moved)] == [torch.float64, torch.int64, torch.bool, torch.float64]
    assert moved.integers is item.integers
    assert torch.equal(moved.integers, item.integers)
    assert torch.equal(moved.flags, item.flags)
    assert (moved.name, moved.note, moved.inner.size) == (item.name, None, (4, 6))


def test_map_detach_and_indexing_reach_every_tensor_and_leave_the_original() -> None:
    item = make(1)
    tracked = replace(item, inner=Inner(item.inner.values.clone().requires_grad_() * 2))
    assert not tracked.detach().inner.values.requires_grad
    for one, other in zip(tensors(item.map(lambda tensor: tensor * 2)), tensors(item), strict=True):
        assert torch.equal(one, other * 2)
    for index in (1, torch.tensor([False, True]), None):
        assert all(torch.equal(a, b[index]) for a, b in zip(tensors(item[index]), tensors(item), strict=True))
    assert torch.equal(item.floats, make(1).floats)


def test_stack_adds_a_leading_axis_and_collects_the_names_also_in_a_data_loader() -> None:
    items = [make(i) for i in range(3)]
    batch = stack(items)
    assert (batch.name, batch.inner.size) == (("scene0", "scene1", "scene2"), (4, 6))
    for i, item in enumerate(items):
        assert all(torch.equal(a, b) for a, b in zip(tensors(batch[i]), tensors(item), strict=True))
    loaded = list(DataLoader(items, batch_size=2, collate_fn=stack, num_workers=1))  # type: ignore[arg-type]
    assert [part.name for part in loaded] == [("scene0", "scene1"), ("scene2",)]
    assert torch.equal(torch.cat([part.integers for part in loaded]), batch.integers)


def test_stack_refuses_nothing_and_static_values_that_differ_even_when_nested() -> None:
    other = replace(make(), inner=Inner(torch.zeros(2, 5), size=(4, 7)))
    with pytest.raises(ValueError, match=r"static values differ.*\(4, 6\).*\(4, 7\)"):
        stack([make(), other])
    with pytest.raises(ValueError, match="empty"):
        stack([])


def test_lightning_moves_a_batch_although_it_is_frozen() -> None:
    batch = stack([make(0), make(1)])
    moved = move_data_to_device({"scenes": [batch]}, torch.device("meta"))["scenes"][0]
    assert isinstance(moved, Outer)
    assert {tensor.device.type for tensor in tensors(moved)} == {"meta"}
    assert moved.name == ("scene0", "scene1")


def test_the_data_loaders_pinning_pins_every_tensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Page-locked memory needs a device; that all tensors are asked for it does not."""
    from torch.utils.data._utils.pin_memory import pin_memory

    asked = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor, *_: asked.append(tensor) or tensor.clone())
    item = make()
    assert isinstance(pin_memory([item])[0], Outer)
    assert {id(tensor) for tensor in asked} == {id(tensor) for tensor in tensors(item)}


@pytest.mark.parametrize(("device", "blocking"), [("cuda", False), ("cpu", True), ("meta", True)])
def test_lightning_copies_a_batch_to_a_gpu_without_waiting(monkeypatch, device, blocking):
    copies = []
    monkeypatch.setattr(Tensor, "to", lambda tensor, *arguments: copies.append(arguments) or tensor)
    move_data_to_device(Inner(torch.zeros(2)), torch.device(device))
    assert copies == [(torch.device(device), None, not blocking)]
