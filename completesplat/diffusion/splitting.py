"""Drawing many samples in parts that fit into memory."""

import logging
from collections.abc import Callable
from typing import TypeVar

import torch

Part = TypeVar("Part")
logger = logging.getLogger(__name__)


def in_parts(draw: Callable[[slice], Part], count: int, most: int | None = None) -> list[Part]:
    """`draw` for all of `count` samples, at most `most` at a time (None: all at once), in their order.

    Where a GPU's memory does not suffice, a part is drawn again by halves, with a warning.
    `torch.cuda.OutOfMemoryError`: a single sample does not fit.
    """
    parts: list[Part] = []
    start, size = 0, min(count if most is None else most, count)
    while start < count:
        try:
            parts.append(draw(slice(start, min(start + size, count))))
        except torch.cuda.OutOfMemoryError:
            if size == 1:
                raise
        else:
            start += size
            continue
        # Not in the handler, where the error still holds what was computed.
        torch.cuda.empty_cache()
        logger.warning("%d samples do not fit into the GPU's memory; going on with %d at a time", size, (size + 1) // 2)
        size = (size + 1) // 2
    return parts
