"""Batches of scenes: in which order, by how many processes, from where after an interruption, and what was left out."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils.data import DataLoader, Sampler

from completesplat.data.loading.distributed import processes
from completesplat.data.loading.scenes import EvaluationScenes, TrainingScenes, collate
from completesplat.data.loading.view_selection import draws
from completesplat.errors import DataError
from completesplat.signals import leave_to_parent

logger = logging.getLogger(__name__)


class EpochSampler(Sampler[tuple[int, int]]):
    """All items, group by group: groups and the items of each in an order drawn from (seed, epoch), with the epoch.

    Lightning calls `set_epoch` before every epoch, also after a resume. Where several processes train, each has its
    own items, equally many (the last few may be left out).
    """

    def __init__(self, groups: Sequence[Sequence[int]], seed: int) -> None:
        self.groups = groups
        self.seed = seed
        self.epoch = 0
        self.start = 0

    def set_epoch(self, epoch: int) -> None:
        """The epoch of the iterations that start from now on."""
        self.epoch = epoch

    def __len__(self) -> int:
        return sum(map(len, self.groups)) // processes()[1]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        # The index behind the last belongs to no item, so the order is independent of what the items draw.
        rng = draws(self.seed, self.epoch, sum(map(len, self.groups)))
        order = [i for group in rng.permutation(len(self.groups)) for i in rng.permutation(self.groups[group])]
        rank, count = processes()
        own = order[rank::count][: len(self)]
        return iter([(self.epoch, int(index)) for index in own[self.start :]])


class SceneLoader:
    """Iterates over batches of scenes, and keeps account of what could not be read.

    It is a loader of its own for Lightning, which restores `state_dict` in the middle of an epoch.

    Args:
        sampler: the order of a training epoch; None: as they are.
        on_bad, max_bad_fraction: see `SceneDataModule`; what is skipped is reported at the end of the epoch.
    """

    def __init__(
        self,
        scenes: TrainingScenes | EvaluationScenes,
        batch_size: int,
        sampler: EpochSampler | None,
        workers: int,
        on_bad: str = "skip",
        max_bad_fraction: float = 0.1,
    ) -> None:
        self.dataset = scenes
        self.batch_size = batch_size
        self.sampler = sampler
        self.batch_sampler = None  # Lightning asks for it wherever there is a sampler
        self.on_bad = on_bad
        self.max_bad_fraction = max_bad_fraction
        self.refused: list[DataError] = []
        self.refused_depths: list[DataError] = []
        self._batches = 0
        self._resume: dict[str, int] = {}
        self._loader = DataLoader(
            scenes,
            batch_size,
            sampler=sampler,
            num_workers=workers,
            persistent_workers=workers > 0,  # They hold what is cached, so they live on from one epoch to the next.
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=leave_to_parent,
            # Its own, so that the numbers which training draws do not depend on the number of workers.
            generator=torch.Generator(),
        )

    def __len__(self) -> int:
        return len(self._loader)

    @property
    def _items(self) -> int:  # of this process in an epoch
        return len(self.dataset if self.sampler is None else self.sampler)

    def __iter__(self) -> Iterator[Any]:
        """The batches of an epoch (`SceneBatch`, or `CachedScene`), or the rest of it after `load_state_dict`.

        Raises:
            DataError: something cannot be read and is not to be skipped, or too much cannot be read, or nothing can.
        """
        resume, self._resume = self._resume, {}
        self.refused, self.refused_depths = [], []
        self._batches = resume.get("batches", 0) if resume.get("epoch") == self._epoch else 0
        if self.sampler is not None:
            self.sampler.start = self._batches * self.batch_size
        try:
            for scenes, refused, refused_depths in self._loader:
                self._batches += 1
                self._account(refused, scenes is None)
                self.refused_depths += refused_depths
                if self._batches == len(self):
                    # Not behind the loop: whoever knows how many batches there are, as Lightning, asks for no more.
                    self._report()
                if scenes is not None:
                    yield scenes
        except GeneratorExit:  # The rest of the epoch is not wanted.
            if self._batches < len(self):
                self._report()
            raise

    # Where Lightning looks for the worker processes when it is done, to end them. Left to the garbage collector, each
    # would go on waiting for 5 seconds, and the training process with it.
    @property
    def _iterator(self) -> Any:
        return self._loader._iterator

    @_iterator.setter
    def _iterator(self, iterator: Any) -> None:
        self._loader._iterator = iterator

    @property
    def _epoch(self) -> int:
        return self.sampler.epoch if self.sampler is not None else 0

    def state_dict(self) -> dict[str, int]:
        """Which epoch it is, and how many batches of it were given out."""
        return {"epoch": self._epoch, "batches": self._batches}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Start the next iteration after the batches of `state`, if it is still that epoch."""
        self._resume = dict(state)

    def _account(self, refused: Sequence[DataError], empty: bool) -> None:
        if refused and self.on_bad == "raise":
            raise refused[0]
        self.refused += refused
        too_many = len(self.refused) > max(1, self.max_bad_fraction * self._items)
        # Evaluation has nothing in the place of what cannot be read.
        nothing = empty and (self.sampler is not None or len(self.refused) == self._items)
        if too_many or nothing:
            limit = f"more than data.max_bad_fraction={self.max_bad_fraction:g} allows"
            what = f"{len(self.refused)} of {self._items} items cannot be read"
            advice = f"see `completesplat data check`; the last one: {self.refused[-1]}"
            raise DataError(f"{what}, {limit if too_many else 'and nothing in their place'}; {advice}")

    def _report(self) -> None:
        if self.refused:
            kinds = ", ".join(f"{count} {kind}" for kind, count in Counter(e.kind for e in self.refused).most_common())
            count, first = f"{len(self.refused)} of {self._items}", self.refused[0]
            logger.warning("skipped %s items (%s); the first: %s", count, kinds, first)
