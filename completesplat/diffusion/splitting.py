"""Drawing many samples in parts that fit into memory."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TypeVar

import torch

from completesplat.tensors import TensorDataclass

Part = TypeVar("Part")
Tensors = TypeVar("Tensors", bound=TensorDataclass)
logger = logging.getLogger(__name__)


def in_parts(draw: Callable[[slice], Part], count: int, most: int | None = None) -> list[Part]:
    """`draw` for all of `count` samples, at most `most` at a time (None: all at once), in their order.

    Where a GPU's memory does not suffice, a part is drawn again by halves, with a warning.

    Raises:
        torch.cuda.OutOfMemoryError: a single sample does not fit.
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


def joined(parts: Sequence[Tensors]) -> Tensors:
    """Parts along the leading axis of all their tensors as one."""
    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
