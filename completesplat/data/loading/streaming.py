"""Training scenes from a prepared store that is read as a stream, each process its own part: for clusters."""

from collections.abc import Iterator
from itertools import count, islice

from torch.utils.data import IterableDataset, get_worker_info

from completesplat.data.loading.distributed import processes
from completesplat.data.loading.scenes import Loaded, TrainingScenes
from completesplat.data.loading.view_selection import draws
from completesplat.data.packed.source import PreparedSource
from completesplat.data.packed.streaming import stream
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.errors import CompleteSplatError, DataError


class StreamedScenes(IterableDataset):
    """The scenes of `TrainingScenes`, without end, in the order in which the store is streamed.

    In one pass every sequence gives one scene; training processes and their workers have disjoint parts of it (a worker
    without a shard of its own has none). Each pass has another order. An item draws what it draws in `TrainingScenes`;
    which items make a batch depends on the number of processes and workers. A resumed epoch goes on exactly where no
    worker is without a part. What cannot be read is left out, and told with the next scene.

    Attributes:
        epoch: of the iterations that start from now on.
        start: items of this process that are left out at the beginning of the next iteration.

    Raises:
        CompleteSplatError: the source is not a prepared store.
    """

    def __init__(self, scenes: TrainingScenes, source: SequenceSource, batch_size: int) -> None:
        if not isinstance(source, PreparedSource):
            raise CompleteSplatError("data.streaming=true needs prepared data: completesplat data prepare")
        self.scenes = scenes
        self.source = source
        self.batch_size = batch_size
        self.epoch = 0
        self.start = 0
        self._numbers = {name: number for number, name in enumerate(source.names)}

    def set_epoch(self, epoch: int) -> None:
        """See `epoch`."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Items of this process in an epoch."""
        return len(self.scenes) // processes()[1]

    def __iter__(self) -> Iterator[Loaded]:
        worker = get_worker_info()
        # Workers give batches in turn; see `unfinished_round`.
        left_out = self.start // self.batch_size // (worker.num_workers if worker else 1) * self.batch_size
        return islice(self._items(), left_out, None)

    def unfinished_round(self, workers: int) -> int:
        """How many batches to leave out after a start in the middle of an epoch, for the next ones to be right."""
        return self.start // self.batch_size % max(workers, 1)

    def _items(self) -> Iterator[Loaded]:
        refused: tuple[DataError, ...] = ()
        for number in count():
            found = False
            for sequence in self._pass(number):
                found = True
                if isinstance(sequence, DataError):
                    refused += (sequence,)
                    continue
                try:
                    item = self._numbers[sequence.name] * self.scenes.references + number % self.scenes.references
                    yield Loaded(self.scenes.make(sequence, draws(self.scenes.seed, self.epoch, item)), refused)
                    refused = ()
                except DataError as error:
                    refused += (error,)
            if not found:
                return

    def _pass(self, number: int) -> Iterator[PosedSequence | DataError]:
        """The sequences of this process and worker, in the order of the pass; damage ends it."""
        seed = int(draws(self.scenes.seed, self.epoch, number).integers(2**31))
        try:
            yield from stream(self.source.manifest.root, "train", *processes(), shuffle_seed=seed)
        except DataError as error:
            yield error
