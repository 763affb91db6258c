"""Learning-rate schedules, stepped once per optimizer step. `total_steps` is the length of the run."""

import math
from collections.abc import Callable

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from completesplat.schema import Natural, Share


def exponential(
    optimizer: Optimizer, total_steps: float, warmup_steps: Natural = 100, final_ratio: Share = 0.01
) -> LambdaLR:
    """Linear warm-up, then exponential decay to `final_ratio` at the end (Marigold, `src/util/lr_scheduler.py`).

    The paper follows Marigold without giving numbers; warm-up and ratio are Marigold's.
    """
    return _after_warmup(optimizer, lambda x: math.exp(math.log(final_ratio) * x), total_steps, warmup_steps)


def cosine(
    optimizer: Optimizer, total_steps: float, warmup_steps: Natural = 100, final_ratio: Share = 0.01
) -> LambdaLR:
    """Linear warm-up, then half a cosine down to `final_ratio` at the end."""
    half_a_cosine = lambda x: final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * x))  # noqa: E731
    return _after_warmup(optimizer, half_a_cosine, total_steps, warmup_steps)


def constant(optimizer: Optimizer, total_steps: float) -> LambdaLR:
    """The optimizer's learning rate throughout, as in the paper's first stage."""
    return LambdaLR(optimizer, lambda step: 1.0)


def _after_warmup(
    optimizer: Optimizer, decay: Callable[[float], float], total_steps: float, warmup_steps: int
) -> LambdaLR:
    """A linear rise, then `decay` of the share of the other steps that is done: none in a run without an end."""

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        return decay(min(1.0, (step - warmup_steps) / max(1, total_steps - warmup_steps)))

    return LambdaLR(optimizer, factor)
