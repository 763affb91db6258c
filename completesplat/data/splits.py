"""Which sequences are for training and which are held out, where the data set does not say."""

import hashlib
from collections.abc import Sequence


def split_by_hash(names: Sequence[str], fraction: float, seed: int) -> tuple[list[str], list[str]]:
    """Training and held-out sequences, in the given order.

    A sequence's side depends on its name and the seed only, so that it stays where it is when others come; only where
    none would be held out is it the one with the smallest hash.
    """
    position = {name: int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:8]) / 2**64 for name in names}
    held_out = {name for name in names if position[name] < fraction}
    held_out = held_out or set(sorted(names, key=position.__getitem__)[:1])
    return [name for name in names if name not in held_out], [name for name in names if name in held_out]
