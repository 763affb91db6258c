"""What functions deep inside do while something else runs: how long they take, and what of theirs is in memory."""

import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any

from completesplat.data.loading import SceneLoader
from completesplat.reports.loading.epochs import read_epoch

# Where image files become pixels, of a published data set and of a prepared one.
DECODERS = ("completesplat.data.transforms.decode", "completesplat.data.prepared.rows.decode")
MEBIBYTE = 2**20

Function = Callable[..., Any]


@contextmanager
def replaced(path: str, wrap: Callable[[Function], Function]) -> Iterator[None]:
    """While it lasts, the function `path` (package.module.name) of a module is `wrap(function)`."""
    module_name, _, name = path.rpartition(".")
    module = import_module(module_name)
    function = getattr(module, name)
    setattr(module, name, wrap(function))
    try:
        yield
    finally:
        setattr(module, name, function)


class Stopwatch:
    """Adds up the seconds that are spent in the functions it wraps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Function) -> Function:
        """The same function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


def decoding_share(loader: SceneLoader) -> float:
    """The share of an epoch's time that decoding image files takes, after an unwatched epoch.

    The loader must read in this process.
    """
    read_epoch(loader, 0)
    watch = Stopwatch()
    with ExitStack() as stack:
        for path in DECODERS:
            stack.enter_context(replaced(path, watch.wrap))
        epoch = read_epoch(loader, 1)
    return watch.seconds / epoch.seconds


class _Counted(dict[Any, Any]):
    """A dictionary that weak references may point to."""


class Counter:
    """Counts the calls of a function, and how many of the dictionaries that it gave are in memory at once.

    Attributes:
        calls: so far.
        most: dictionaries in memory at once, the one that is being made included.
    """

    def __init__(self) -> None:
        self.calls = 0
        self.most = 0
        self._given: list[weakref.ref[_Counted]] = []

    def wrap(self, function: Function) -> Function:
        """The same function, counted."""

        def counted(*args: Any, **kwargs: Any) -> Any:
            self._given = [given for given in self._given if given() is not None]
            self.calls += 1
            self.most = max(self.most, len(self._given) + 1)
            result = _Counted(function(*args, **kwargs))
            self._given.append(weakref.ref(result))
            return result

        return counted


def chunks(data: Any, read_chunk: str) -> dict[str, Any]:
    """How many chunks there are and how large, how many an epoch reads, and how many are in memory at once.

    Args:
        data: a module without workers; its training clips lie in chunks, `<root>/train/*.torch`.
        read_chunk: the function that reads one of them.
    """
    sizes = [path.stat().st_size for path in (data.root / "train").glob("*.torch")]
    counter = Counter()
    with replaced(read_chunk, counter.wrap):
        read_epoch(data.train_dataloader(), 0)
    return {
        "files": len(sizes),
        "largest_mb": max(sizes) / MEBIBYTE,
        "read_in_an_epoch": counter.calls,
        "most_in_memory": counter.most,
    }
