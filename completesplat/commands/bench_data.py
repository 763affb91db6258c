"""`completesplat bench data`: reading from published and prepared forms of the same scenes, side by side."""

import json
import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write scenes, read them in all their forms; write `data.json`, print tables."""
    from completesplat.benchmarks import data
    from completesplat.results.machine import machine

    check_settings(config)
    folder = Path(mkdtemp(prefix="bench_data_", dir=out))
    try:
        with _warnings_only("completesplat.data"):
            figures = _figures(config, folder)
    finally:
        if not config.keep:
            shutil.rmtree(folder)
    results = {"machine": machine(), "not_measured": {}, **figures}
    if "opening" in figures and "added_mb" not in figures["opening"]:
        results["not_measured"] = {"memory": "this system has no /proc/self/status"}
    (out / "data.json").write_text(json.dumps(results, indent=2) + "\n")
    data.show(results)


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning, before anything is written.

    Raises:
        CompleteSplatError: names the setting and what it may be.
    """
    from completesplat.data.packed.rows import CODECS

    for name, example in {"workers": 0, "codecs": "png"}.items():
        if isinstance(config[name], int | str) or not config[name]:
            raise CompleteSplatError(f"{name}={config[name]}: must be a list, such as {name}=[{example}]")
    if any(count < 0 for count in config.workers):
        raise CompleteSplatError(f"workers={config.workers}: must not be negative")
    if not set(config.codecs) <= set(CODECS):
        raise CompleteSplatError(f"codecs={config.codecs}: choose from {', '.join(CODECS)}")
    limits = [("repeats", config.repeats, 1)]
    if config.opening:
        # One for training and one for validation.
        limits += [("opening.sequences", config.opening.sequences, 2), ("opening.epochs", config.opening.epochs, 1)]
    for name, value, least in limits:
        if value < least:
            raise CompleteSplatError(f"{name}={value}: must be at least {least}")


def _figures(config: Any, folder: Path) -> dict[str, Any]:
    from hydra.utils import instantiate
    from rich.console import Console

    # Everything is written before anything is read: writing shows progress bars of its own.
    codecs = list(config.codecs)
    objects = _objects(instantiate(config.objects, _convert_="all"), codecs, folder)
    rooms = _rooms(instantiate(config.rooms, _convert_="all"), codecs, folder) if config.rooms else {}
    store = _store(objects, config, folder) if config.opening else None
    with Console(stderr=True).status("reading") as status:
        return _measure(objects, rooms, store, config, lambda text: status.update(f"reading {text}"))


def _objects(settings: dict[str, Any], codecs: list[str], folder: Path) -> dict[str, Any]:
    """Makers of data modules by the form they read; the form as published comes first."""
    from completesplat.benchmarks.data import prepared

    settings["write"](out=folder / "objects")
    data = partial(settings["data"], root=str(folder / "objects"))
    references = settings["references_per_sequence"]
    fast = prepared(partial(data, references_per_sequence=references["prepared"]), folder / "prepared objects", codecs)
    return {"raw": partial(data, references_per_sequence=references["raw"]), **fast}


def _rooms(settings: dict[str, Any], codecs: list[str], folder: Path) -> dict[str, Any]:
    from completesplat.benchmarks.data import prepared

    root = settings["write"](out=folder / "rooms")
    chunks, text = (partial(settings["data"], root=str(root / form)) for form in ("chunks", "text"))
    return {"chunks": chunks, "text": text, **prepared(text, folder / "prepared rooms", codecs)}


def _store(objects: dict[str, Any], config: Any, folder: Path) -> Any:
    from completesplat.benchmarks.data import repeated

    codec = config.codecs[0]
    few = partial(objects[f"prepared {codec}"], references_per_sequence=1)
    return repeated(few, config.opening.sequences, folder / "many", codec)


def _measure(
    objects: dict[str, Any], rooms: dict[str, Any], store: Any, config: Any, tick: Callable[[str], None]
) -> dict[str, Any]:
    from completesplat.benchmarks.data import chunks, decoding_share, opening, rows

    figures: dict[str, Any] = {"rows": rows(objects, list(config.workers), config.repeats, tick)}
    for name, make in objects.items():
        tick(f"{name}: time in decoding")
        share = decoding_share(make(workers=0).train_dataloader())
        for row in figures["rows"]:
            if (row["form"], row["workers"]) == (name, 0):
                row["decoding_share"] = share
    if store is not None:
        tick("many sequences in a fresh process")
        figures["opening"] = {"sequences": config.opening.sequences, **opening(store, config.opening.epochs)}
    if rooms:
        figures["clips"] = rows(rooms, list(config.workers), config.repeats, tick)
        figures["chunks"] = chunks(rooms["chunks"](workers=0), config.rooms.read_chunk)
    return figures


@contextmanager
def _warnings_only(name: str) -> Iterator[None]:
    """Each of dozens of data modules would say how many sequences it has."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(before)
