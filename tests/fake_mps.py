"""A device that stands in for Apple's MPS: it has no float64, and its tensors do not mix with those of the CPU."""

from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

MPS = torch.device("mps")
MIXED = (torch.Tensor.copy_, torch.Tensor.__getitem__, torch.Tensor.__setitem__)  # torch copies in these


class OnMPS(Tensor):
    """A tensor that says it is on MPS; its values are on the CPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl  # the mode alone makes these tensors


class FakeMPS(TorchFunctionMode):
    """Within it, `.to("mps")` and `device="mps"` give such tensors, and torch's refusals for MPS are raised."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        here = any(isinstance(tensor, OnMPS) for tensor in tensors)
        if func == Tensor.device.__get__ and here:
            return MPS
        if func == Tensor.numpy and here:
            raise TypeError("can't convert mps:0 device type tensor to numpy")
        if func == Tensor.cpu:
            return _plain(args[0])
        if func == Tensor.to:
            if len(args) > 1 and isinstance(args[1], Tensor):
                device, dtype = MPS if isinstance(args[1], OnMPS) else args[1].device, args[1].dtype
            else:
                device, dtype, *_ = torch._C._nn._parse_to(*args[1:], **kwargs)
            there = isinstance(args[0], OnMPS) if device is None else device.type == MPS.type
            value = _plain(args[0]).to(dtype or args[0].dtype)
            return self._placed(value, there)
        asked = kwargs.get("device")
        if asked is not None and torch.device(asked).type == MPS.type:
            kwargs["device"], here = "cpu", True
        elif here and func not in MIXED and any(type(x) is Tensor and x.dim() for x in tensors):
            raise RuntimeError("Expected all tensors to be on the same device, but found at least two: mps:0 and cpu")
        if func is not torch.autograd.grad:  # which needs the tensors of the graph themselves
            args, kwargs = tree_map_only(Tensor, _plain, (args, kwargs))
        values = func(*args, **kwargs)
        return tree_map_only(Tensor, lambda value: self._placed(value, here), values)

    @staticmethod
    def _placed(value: Tensor, here: bool) -> Tensor:
        if here and value.dtype == torch.float64:
            raise TypeError(
                "Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64."
            )
        return value.as_subclass(OnMPS) if here else value


def _plain(tensor: Tensor) -> Tensor:
    return tensor.as_subclass(Tensor) if isinstance(tensor, OnMPS) else tensor
