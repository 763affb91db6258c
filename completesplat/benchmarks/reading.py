"""Speed of reading training batches, its share of decoding, and its memory."""

import statistics
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from completesplat.data.loading.loader import SceneLoader

# Makes a data module from the settings that are still open (workers, ...).
MakeData = Callable[..., Any]


class Epoch(NamedTuple):
    """Numbers of batches, scenes and images of one epoch, and the seconds that reading them took."""

    seconds: float
    batches: int
    scenes: int
    images: int


def rows(
    forms: Mapping[str, MakeData], workers: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return a row per number of workers and form: rates of batches, scenes and images, and speed-up to the first form.

    The forms take turns. The median of `repeats` epochs counts for each form, after an untimed one in which workers
    start and files come into memory.
    """
    result = []
    for count in workers:
        loaders = {}
        for name, make in forms.items():
            tick(f"{name}, {count} workers: first epoch")
            loaders[name] = make(workers=count).train_dataloader()
            read_epoch(loaders[name], 0)
        epochs: dict[str, list[Epoch]] = {name: [] for name in forms}
        for number in range(1, repeats + 1):
            for name, loader in loaders.items():
                tick(f"{name}, {count} workers: epoch {number} of {repeats}")
                epochs[name].append(read_epoch(loader, number))
        rates = {name: _rates(taken) for name, taken in epochs.items()}
        first = rates[next(iter(forms))]["scenes_per_second"]
        result += [
            {"form": name, "workers": count} | rate | {"times_first": rate["scenes_per_second"] / first}
            for name, rate in rates.items()
        ]
    return result


def read_epoch(loader: SceneLoader, number: int) -> Epoch:
    """Read all batches of an epoch and do nothing with them."""
    if loader.sampler is not None:
        loader.sampler.set_epoch(number)
    batches = scenes = images = 0
    start = time.perf_counter()
    for batch in loader:
        count, targets = batch.targets.images.shape[:2]
        batches += 1
        scenes += count
        images += count * (1 + targets)
    return Epoch(time.perf_counter() - start, batches, scenes, images)


def _rates(epochs: Sequence[Epoch]) -> dict[str, float]:
    seconds = statistics.median(epoch.seconds for epoch in epochs)
    first = epochs[0]
    return {
        "epoch_seconds": seconds,
        "batches_per_second": first.batches / seconds,
        "scenes_per_second": first.scenes / seconds,
        "images_per_second": first.images / seconds,
    }


KIBIBYTES_OF_MEBIBYTE = 1024
STATUS = Path("/proc/self/status")
KEYS = {"anonymous": "RssAnon", "file": "RssFile"}


def resident_megabytes() -> dict[str, float] | None:
    """Return the resident memory of this process in MB, `anonymous` and `file`; None if the system does not tell.

    `anonymous` is the process's own memory. `file` counts the pages of mapped files that were touched, which the system
    takes back when it needs them.
    """
    if not STATUS.exists():
        return None
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return {name: int(lines[key].split()[0]) / KIBIBYTES_OF_MEBIBYTE for name, key in KEYS.items()}


def opening_figures(make: MakeData, epochs: int) -> dict[str, Any]:
    """Open a data module in a new process, and read its training items for some epochs there.

    Returns:
        `seconds` to open it (train and val); `added_mb`, the resident memory that opening adds to the imports;
        `growth_mb` of anonymous memory from the end of the first epoch to that of the last one; `steps` with resident
        memory after each, seconds and CPU time (`cpu_seconds`). Memory is missing if the system does not tell it.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        steps = pool.submit(_steps, make, epochs).result()
    result = {"seconds": steps[1]["seconds"], "scenes": steps[2]["scenes"]}
    if "anonymous_mb" in steps[0]:
        result["added_mb"] = _resident(steps[1]) - _resident(steps[0])
        result["growth_mb"] = steps[-1]["anonymous_mb"] - steps[2]["anonymous_mb"]
    return result | {"steps": steps}


def _resident(step: dict[str, Any]) -> float:
    return float(step["anonymous_mb"] + step["file_mb"])


def _steps(make: MakeData, epochs: int) -> list[dict[str, Any]]:
    """Return an entry after the imports, one after opening, and one after each epoch."""
    import datasets  # noqa: F401  the store imports it with its first sequence

    steps = [_step("imports")]
    start, busy = time.perf_counter(), time.process_time()
    data = make(workers=0)
    data.setup("fit")
    seconds = {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - busy}
    steps.append(_step("opening", **seconds))
    loader = data.train_dataloader()
    for number in range(epochs):
        busy = time.process_time()
        epoch = read_epoch(loader, number)
        seconds = {"seconds": epoch.seconds, "cpu_seconds": time.process_time() - busy}
        steps.append(_step(f"epoch {number + 1}", **seconds, scenes=epoch.scenes))
    return steps


def _step(name: str, **figures: float) -> dict[str, Any]:
    resident = resident_megabytes() or {}
    return {"after": name, **figures, **{f"{kind}_mb": value for kind, value in resident.items()}}


# The functions that decode image files of a published and of a packed data set.
DECODERS = ("completesplat.data.images.crop.decode", "completesplat.data.packed.rows.decode")
MEBIBYTE = 2**20

Function = Callable[..., Any]


@contextmanager
def replaced(path: str, wrap: Callable[[Function], Function]) -> Iterator[None]:
    """Within the context, replace the function `path` (package.module.name) by `wrap(function)`."""
    module_name, _, name = path.rpartition(".")
    module = import_module(module_name)
    function = getattr(module, name)
    setattr(module, name, wrap(function))
    try:
        yield
    finally:
        setattr(module, name, function)


class Stopwatch:
    """Sum of the seconds that are spent in wrapped functions."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Function) -> Function:
        """Return the same function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


def decoding_share(loader: SceneLoader) -> float:
    """Return the share of an epoch's time that decoding image files takes, after an unwatched epoch.

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
    """A dictionary to which weak references are possible."""


class Counter:
    """Counter of a function's calls, and of the returned dictionaries that are in memory at once.

    Attributes:
        calls: number of calls so far.
        most: largest number of dictionaries in memory at once, including the one that is being made.
    """

    def __init__(self) -> None:
        self.calls = 0
        self.most = 0
        self._given: list[weakref.ref[_Counted]] = []

    def wrap(self, function: Function) -> Function:
        """Return the same function, counted."""

        def counted(*args: Any, **kwargs: Any) -> Any:
            self._given = [reference for reference in self._given if reference() is not None]
            self.calls += 1
            self.most = max(self.most, len(self._given) + 1)
            result = _Counted(function(*args, **kwargs))
            self._given.append(weakref.ref(result))
            return result

        return counted


def chunks(data: Any, read_chunk: str) -> dict[str, Any]:
    """Return the number of chunks and their largest size, and how many an epoch reads and holds in memory at once.

    `data` is a module without workers; the function named `read_chunk` reads its chunks, `<root>/train/*.torch`.
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
