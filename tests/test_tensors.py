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
    return Outer(
        floats=torch.arange(6.0).reshape(2, 3) + index,
        integers=torch.arange(2) + 2**40 + index,
        flags=torch.tensor([True, False]),
        inner=Inner(torch.full((2, 5), float(index))),
        name=f"scene{index}",
    )


def tensors(item: Outer) -> list[Tensor]:
    return [item.floats, item.integers, item.flags, item.inner.values]


@pytest.mark.parametrize(
    ("args", "kwargs"),
    [
        ((torch.float64,), {}),
        ((), {"dtype": torch.float64}),
        (("cpu", torch.float64), {}),
        (("cpu",), {"dtype": torch.float64}),
        ((torch.zeros(1, dtype=torch.float64),), {}),
        ((), {"dtype": torch.float64, "copy": True}),
    ],
)
def test_to_casts_only_floats_in_every_form_of_the_call(args: tuple, kwargs: dict) -> None:
    item = make(3)
    moved = item.to(*args, **kwargs)
    assert [tensor.dtype for tensor in tensors(moved)] == [torch.float64, torch.int64, torch.bool, torch.float64]
    assert (moved.integers is item.integers) == ("copy" not in kwargs)
    assert torch.equal(moved.integers, item.integers)
    assert torch.equal(moved.flags, item.flags)
    assert (moved.name, moved.note, moved.inner.size) == (item.name, None, (4, 6))


def test_map_detach_and_to_reach_every_tensor_and_leave_the_original() -> None:
    item = make()
    assert {tensor.device.type for tensor in tensors(item.to("meta"))} == {"meta"}
    tracked = replace(item, inner=Inner(item.inner.values.clone().requires_grad_() * 2))
    assert not tracked.detach().inner.values.requires_grad
    doubled = item.map(lambda tensor: tensor * 2)
    assert torch.equal(doubled.inner.values, item.inner.values * 2)
    assert torch.equal(doubled.integers, item.integers * 2)
    assert torch.equal(item.floats, make().floats)


def test_indexing_acts_on_the_leading_axes_of_all_tensors() -> None:
    item = make()
    assert torch.equal(item[1].floats, item.floats[1])
    assert torch.equal(item[1].inner.values, item.inner.values[1])
    mask = torch.tensor([False, True])
    assert torch.equal(item[mask].inner.values, item.inner.values[1:])
    assert item[None].floats.shape == (1, 2, 3)


def test_stack_adds_a_leading_axis_and_collects_the_names() -> None:
    items = [make(i) for i in range(3)]
    batch = stack(items)
    assert batch.floats.shape == (3, 2, 3)
    assert batch.inner.values.shape == (3, 2, 5)
    assert batch.name == ("scene0", "scene1", "scene2")
    assert batch.inner.size == (4, 6)
    for i, item in enumerate(items):
        assert torch.equal(batch[i].floats, item.floats)
        assert torch.equal(batch[i].inner.values, item.inner.values)


def test_stack_refuses_static_values_that_differ_even_when_nested() -> None:
    other = replace(make(), inner=Inner(torch.zeros(2, 5), size=(4, 7)))
    with pytest.raises(ValueError, match=r"static values differ.*\(4, 6\).*\(4, 7\)"):
        stack([make(), other])
    with pytest.raises(ValueError, match="static values differ"):
        stack([make(), replace(make(), note="text")])
    with pytest.raises(ValueError, match="empty"):
        stack([])


@pytest.mark.parametrize("workers", [0, 1])
def test_a_data_loader_collates_with_stack(workers: int) -> None:
    items = [make(i) for i in range(5)]
    batches = list(DataLoader(items, batch_size=2, collate_fn=stack, num_workers=workers))  # type: ignore[arg-type]
    assert [batch.name for batch in batches] == [("scene0", "scene1"), ("scene2", "scene3"), ("scene4",)]
    assert torch.equal(torch.cat([batch.integers for batch in batches]), torch.stack([i.integers for i in items]))


def test_lightning_moves_a_batch_although_it_is_frozen() -> None:
    batch = stack([make(0), make(1)])
    moved = move_data_to_device({"scenes": [batch]}, torch.device("meta"))["scenes"][0]
    assert isinstance(moved, Outer)
    assert moved.inner.values.device.type == "meta"
    assert moved.name == ("scene0", "scene1")


def test_the_data_loaders_pinning_pins_every_tensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Page-locked memory needs a device; that all tensors are asked for it does not."""
    from torch.utils.data._utils.pin_memory import pin_memory

    asked = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor, *_: asked.append(tensor) or tensor.clone())
    item = make()
    pinned = pin_memory([item])[0]
    assert isinstance(pinned, Outer)
    assert {id(tensor) for tensor in asked} == {id(tensor) for tensor in tensors(item)}
    assert pinned.inner.values is not item.inner.values


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_pinned_memory_on_a_device() -> None:
    assert make().pin_memory().inner.values.is_pinned()
