"""Learning-rate schedules, stepped once per optimizer step."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def exponential(optimizer: Optimizer, total_steps: int, warmup_steps: int = 100, final_ratio: float = 0.01) -> LambdaLR:
    """Linear warm-up, then exponential decay to `final_ratio` at `total_steps` (Marigold, `src/util/lr_scheduler.py`).

    The paper follows Marigold without giving numbers; warm-up and ratio are Marigold's.
    """

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        progress = min(1.0, (step - warmup_steps) / max(1, total_steps - warmup_steps))
        return math.exp(math.log(final_ratio) * progress)

    return LambdaLR(optimizer, factor)


def cosine(optimizer: Optimizer, total_steps: int, warmup_steps: int = 100, final_ratio: float = 0.01) -> LambdaLR:
    """Linear warm-up, then half a cosine down to `final_ratio` at `total_steps`."""

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        progress = min(1.0, (step - warmup_steps) / max(1, total_steps - warmup_steps))
        return final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * progress))

    return LambdaLR(optimizer, factor)


def constant(optimizer: Optimizer) -> LambdaLR:
    """The optimizer's learning rate throughout, as in the paper's first stage."""
    return LambdaLR(optimizer, lambda step: 1.0)
