"""Loader of scene batches: seeded order, several processes, resumption within an epoch, report of skipped items."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch.utils.data import DataLoader, Sampler, SequentialSampler
from torch.utils.data.dataloader import _BaseDataLoaderIter

from completesplat.data.loading.distributed import processes
from completesplat.data.loading.scenes import EvaluationScenes, TrainingScenes, collate
from completesplat.data.loading.view_selection import item_generator
from completesplat.data.loading.worker_folder import prepare_worker, worker_folder
from completesplat.data.tolerance import ErrorTolerance
from completesplat.errors import CompleteSplatError, DataError

logger = logging.getLogger(__name__)


class EpochSampler(Sampler[tuple[int, int]]):
    """Sampler of (epoch, item), one group after the other. (seed, epoch) determines the order of groups and items.

    Lightning calls `set_epoch` before every epoch, also after a resume. Several processes get different items, all
    equally many (the last few items may be left out).
    """

    def __init__(self, groups: Sequence[Sequence[int]], seed: int) -> None:
        self.groups = groups
        self.seed = seed
        self.epoch = 0
        self.start = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of all iterations that start after this call."""
        self.epoch = epoch

    def __len__(self) -> int:
        return sum(map(len, self.groups)) // processes()[1]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch = 0 if isinstance(self, RepeatedEpoch) else self.epoch
        # The index after the last belongs to no item, so the order is independent of what the items draw.
        rng = item_generator(self.seed, epoch, sum(map(len, self.groups)))
        order: list[int] = []
        for group in rng.permutation(len(self.groups)):
            order.extend(rng.permutation(self.groups[group]))
        rank, count = processes()
        local = order[rank::count][: len(self)]
        return iter([(epoch, int(index)) for index in local[self.start :]])


def workers_refusal(error: BaseException) -> str | None:
    """Return one line for an error of worker processes that lack shared memory or open files, else None.

    Their tensors lie in `/dev/shm`, of which Docker gives 64 MB, or in open files.
    """
    text = str(error)
    shared = "shared memory" in text or "Bus error" in text or "No space left on device" in text
    files = "Too many open files" in text or "received 0 items of ancdata" in text
    if files:
        return "data.workers: too many open files; raise `ulimit -n`, or set data.workers=0"
    if shared:
        advice = "start the container with --shm-size=2g or --ipc=host, or set data.workers=0"
        return f"data.workers: no space in shared memory (/dev/shm); {advice}"
    return None


class RepeatedEpoch(EpochSampler, SequentialSampler):  # type: ignore[misc]
    """Sampler of the first epoch's items in all epochs, for `trainer.overfit_batches`. Lightning asks for its base."""


class SceneLoader:
    """Iterable over batches of scenes that counts and reports the items that cannot be read.

    It wraps a `DataLoader` because Lightning restores `state_dict` in the middle of an epoch.

    Args:
        sampler: order of a training epoch; None: the order of `scenes`.
        tolerance: rule for items that cannot be read; skipped ones are reported at the end of the epoch.
    """

    def __init__(
        self,
        scenes: TrainingScenes | EvaluationScenes,
        batch_size: int,
        sampler: EpochSampler | None,
        workers: int,
        tolerance: ErrorTolerance,
    ) -> None:
        self.dataset = scenes
        self.batch_size = batch_size
        self._order = sampler
        self.batch_sampler = None  # Lightning asks for it wherever there is a sampler
        self.tolerance = tolerance
        self.refused: list[DataError] = []
        self.refused_depths: list[DataError] = []
        self._batches = 0
        self._resume: dict[str, int] = {}
        self._loader = DataLoader(
            scenes,
            batch_size,
            sampler=sampler,
            num_workers=workers,
            persistent_workers=workers > 0,  # Workers hold the cached images, so they outlive an epoch.
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=partial(prepare_worker, worker_folder() if workers > 0 else None),
            # A separate generator, so that the random numbers of training do not depend on the number of workers.
            generator=torch.Generator(),
        )

    def __len__(self) -> int:
        return len(self._loader)

    @property
    def sampler(self) -> Iterable[Any]:
        """Return the sampler of items, whose epoch Lightning sets."""
        return self._loader.sampler

    @property
    def _items(self) -> int:
        """Number of this process's items in an epoch."""
        return len(self.dataset if self._order is None else self._order)

    def __iter__(self) -> Iterator[Any]:
        """Yield the batches (`SceneBatch` or `CachedScene`) of an epoch, or the rest of it after `load_state_dict`.

        Raises:
            DataError: an item cannot be read and `on_bad` is "raise", too many cannot be read, or none can.
        """
        resume = self._resume
        self._resume = {}
        self.refused = []
        self.refused_depths = []
        self._batches = resume.get("batches", 0) if resume.get("epoch") == self._epoch else 0
        if self._order is not None:
            self._order.start = self._batches * self.batch_size
        try:
            for scenes, refused, refused_depths in self._loader:
                self._batches += 1
                self.account(refused, scenes is None)
                self.refused_depths += refused_depths
                if self._batches == len(self):
                    # Not after the loop, because Lightning knows the number of batches and never exhausts the iterator.
                    self._report()
                if scenes is not None:
                    yield scenes
        except (RuntimeError, OSError) as error:
            reason = workers_refusal(error)
            if reason is None:
                raise
            raise CompleteSplatError(reason) from error
        except GeneratorExit:  # The caller stopped before the end of the epoch.
            if self._batches < len(self):
                self._report()
            raise

    # Lightning ends the worker processes that it finds under this name. The garbage collector would wait 5 seconds for
    # each of them, and delay the training process.
    @property
    def _iterator(self) -> _BaseDataLoaderIter | None:
        return self._loader._iterator

    @_iterator.setter
    def _iterator(self, iterator: _BaseDataLoaderIter | None) -> None:
        self._loader._iterator = iterator

    @property
    def _epoch(self) -> int:
        return self._order.epoch if self._order is not None else 0

    def state_dict(self) -> dict[str, int]:
        """Return the current epoch and the number of its batches that were read."""
        return {"epoch": self._epoch, "batches": self._batches}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration start after the batches counted in `state`, if the epoch is still the same."""
        self._resume = dict(state)

    def account(self, refused: Sequence[DataError], empty: bool) -> None:
        """Count items that cannot be read. Raise DataError if they are too many, or nothing is left (`empty`)."""
        for error in refused:
            self.tolerance.check(error)
        self.refused += refused
        too_many = self.tolerance.is_exceeded(len(self.refused), self._items)
        # Training replaces unreadable items, so an empty batch is an error there. Evaluation does not replace them.
        nothing = empty and (self._order is not None or len(self.refused) == self._items)
        if not (too_many or nothing):
            return
        limit = "and nothing in their place"
        if too_many:
            limit = f"more than data.max_bad_fraction={self.tolerance.max_bad_fraction:g} allows"
        advice = f"see `completesplat data check`; the last one: {self.refused[-1]}"
        raise DataError(f"{len(self.refused)} of {self._items} items cannot be read, {limit}; {advice}")

    def _report(self) -> None:
        if self.refused:
            counts = Counter(error.kind for error in self.refused)
            kinds = ", ".join(f"{count} {kind}" for kind, count in counts.most_common())
            share = f"{len(self.refused)} of {self._items}"
            logger.warning("skipped %s items (%s); the first: %s", share, kinds, self.refused[0])
