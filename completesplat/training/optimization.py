"""Muon, and learning-rate schedules that step once per optimizer step. `steps` is the length of the run."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from completesplat.quantities import Natural, NonNegative, Range, Share


def muon(
    parameters: Iterable[Tensor],
    lr: NonNegative,
    adam_lr: NonNegative,
    adam_betas: tuple[Share, Share] = (0.9, 0.99),
) -> Optimizer:
    """Build Muon (Jordan 2024) for matrices and kernels, with Adam for biases and norms.

    A convolution's kernel is treated as the matrix [out in*height*width]. An update has about the same length in all
    directions, so Muon needs fewer steps than Adam but, on a CPU, a third more time for each.

    Args:
        lr: learning rate of matrices and kernels. The size of their gradients makes no difference.
        adam_lr, adam_betas: learning rate and betas of biases and norms.
    """
    from pytorch_optimizer import Muon  # imports a hundred other modules

    tensors = list(parameters)
    matrices = [tensor for tensor in tensors if tensor.ndim > 1]
    vectors = [tensor for tensor in tensors if tensor.ndim < 2]
    groups: list[dict[str, Any]] = []
    if matrices:
        groups.append({"params": matrices, "lr": lr, "use_muon": True})
    if vectors:
        groups.append({"params": vectors, "lr": adam_lr, "betas": adam_betas, "use_muon": False})
    optimizer: Optimizer = Muon(groups)
    if tensors[0].device.type == "cpu":
        optimizer._orthogonalize = _orthogonal  # type: ignore[attr-defined]
    return optimizer


def _orthogonal(group: Mapping[str, Any], updates: Sequence[Tensor]) -> list[Tensor]:
    """Orthogonalise as Muon does, but iterate on X X^T alone ("Gram"), in float32.

    On a CPU with bfloat16 this takes two thirds of the time of the library's way, which computes in it, and comes
    nearer to its limit. On a CPU without, the library's way takes a hundred times as long. Only in less than float32
    do the iterations need to start anew from X X^T (`reset_steps`).
    """
    from pytorch_optimizer.optimizer.utils.matrix import zero_power_via_gram_newton_schulz

    settings = {"num_steps": group["ns_steps"], "weights": group["ns_coeffs"], "dtype": torch.float32}
    return [zero_power_via_gram_newton_schulz(x.flatten(1), **settings, reset_steps=()) for x in updates]


class Schedule(LambdaLR):
    """Learning-rate schedule that takes only its step from a checkpoint, and its rates and end from the config."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go to the checkpoint's step, after the optimizer's state is loaded, whose rates this replaces."""
        super().load_state_dict(state_dict | {"base_lrs": self.base_lrs})
        self._last_lr = [rate * at(self.last_epoch) for rate, at in zip(self.base_lrs, self.lr_lambdas, strict=True)]
        for group, rate in zip(self.optimizer.param_groups, self._last_lr, strict=True):
            group["lr"] = rate


def exponential(
    optimizer: Optimizer,
    steps: float,
    warmup_steps: Natural = 100,
    final_ratio: Annotated[float, Range(1e-9, 1)] = 0.01,
) -> LambdaLR:
    """Build linear warm-up, then exponential decay to `final_ratio` at the end (Marigold, `src/util/lr_scheduler.py`).

    The paper follows Marigold without giving numbers. Warm-up and ratio are Marigold's.
    """
    return _after_warmup(optimizer, lambda x: math.exp(math.log(final_ratio) * x), steps, warmup_steps)


def cosine(optimizer: Optimizer, steps: float, warmup_steps: Natural = 100, final_ratio: Share = 0.01) -> LambdaLR:
    """Build linear warm-up, then half a cosine down to `final_ratio` at the end."""

    def half_a_cosine(x: float) -> float:
        return final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * x))

    return _after_warmup(optimizer, half_a_cosine, steps, warmup_steps)


def constant(optimizer: Optimizer, steps: float) -> LambdaLR:
    """Keep the optimizer's learning rate throughout, as in the paper's first stage."""
    return Schedule(optimizer, lambda step: 1.0)


def _after_warmup(optimizer: Optimizer, decay: Callable[[float], float], steps: float, warmup_steps: int) -> LambdaLR:
    """Build a linear rise, then `decay` of the completed share of the remaining steps (0 in a run without an end)."""

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        return decay(min(1.0, (step - warmup_steps) / max(1, steps - warmup_steps)))

    return Schedule(optimizer, factor)
