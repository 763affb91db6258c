"""A prepared store as a stream that the processes of a cluster divide among them."""

from collections.abc import Iterator
from pathlib import Path

from completesplat.data.packed.rows import from_row
from completesplat.data.packed.source import PreparedSource, open_shard
from completesplat.data.sequences import PosedSequence

SHUFFLED_AT_ONCE = 64


def stream(
    root: Path, split: str, rank: int = 0, world_size: int = 1, shuffle_seed: int | None = None
) -> Iterator[PosedSequence]:
    """The sequences of a split that fall to one of `world_size` processes: disjoint, and complete together.

    In a worker process of torch's `DataLoader`, those of its shards.

    Nothing but the shards is read: no network, no cache in the home folder.

    Args:
        shuffle_seed: the order is that of the shards, or with a seed (the same on all ranks) shuffled: shards first,
            then within a window of 64 sequences.

    Raises:
        DataError: as `PreparedSource`, and when a sequence turns out to be damaged.
    """
    from datasets import concatenate_datasets  # See `features`.
    from datasets.distributed import split_dataset_by_node

    source = PreparedSource(root, split)
    files = {name: str(root / shard.file) for shard in source.shards for name in shard.sequences}
    opened = [open_shard(root / shard.file, shard) for shard in source.shards if shard.sequences]
    if not opened:
        return
    rows = concatenate_datasets(opened).to_iterable_dataset(num_shards=len(opened))
    if shuffle_seed is not None:
        rows = rows.shuffle(seed=shuffle_seed, buffer_size=SHUFFLED_AT_ONCE)
    for row in split_dataset_by_node(rows, rank=rank, world_size=world_size).with_format("arrow"):
        name = row.column("name")[0].as_py()
        yield from_row(row, files.get(name, str(root)), name)
