"""`completesplat bench clips`: what opening and reading a packed store costs a clip, for few and for many of them."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Any

from rich.console import Console

from completesplat.benchmarks.data_loading import repeated
from completesplat.benchmarks.printing import print_results
from completesplat.benchmarks.reading import opening_figures
from completesplat.commands.protocol import write_json
from completesplat.results.machine import machine
from completesplat.results.tables import Column, table
from completesplat.schema import Entries, Positive, Range

CODEC = "bmp"
COLUMNS: list[Column] = [
    ("clips", "clips", ",d"),
    ("opening\ns", "open_seconds", ",.3f"),
    ("epoch\ns", "epoch_seconds", ",.1f"),
    ("memory\nMB", "memory_mb", ",.1f"),
    ("opening\nµs a clip", "open_us", ",.1f"),
    ("epoch\nµs an item", "epoch_us", ",.0f"),
    ("memory\nkB a clip", "memory_kb", ",.2f"),
]


def run(
    write: Callable[..., Path],
    data: Callable[..., Any],
    clips: Annotated[Sequence[Annotated[int, Range(2)]], Entries(1)],
    epochs: Positive,
    out: Path,
) -> None:
    """Write stores of so many clips, open and read each in a process of its own; write `clips.json`, print a table.

    Args:
        write: (out) makes the few clips that are repeated; the folder of their texts is `out/text`.
        data: (root) -> their data module, which the stores are read with, too.
        clips: how many.
        epochs: that are read of each store; the fastest counts.
    """
    folder = Path(mkdtemp(prefix="bench_clips_", dir=out))
    try:
        few = partial(data, root=str(write(out=folder / "few") / "text"))
        found = []
        for count in clips:
            make = repeated(few, count, folder / "many", CODEC)
            with Console(stderr=True).status(f"reading {count:,} clips in a fresh process"):
                found.append(_figures(count, opening_figures(make, epochs)))
            shutil.rmtree(folder / "many")
    finally:
        shutil.rmtree(folder)
    results: dict[str, Any] = {"machine": machine(), "not_measured": {}, "rows": found}
    write_json(out / "clips.json", results)
    hardware = f"{results['machine']['processor']}, {results['machine']['cores']} cores"
    print_results(results, hardware, [table("A packed store of many tiny clips", COLUMNS, found)])


def _figures(count: int, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Figures of one store: all of it, and for each clip or item; no memory where the system does not tell.

    Seconds are the processor's, which other programs change by little.
    """
    steps = measured["steps"]
    opening, epoch = steps[1]["cpu_seconds"], min(step["cpu_seconds"] for step in steps[2:])
    row = {"clips": count, "open_seconds": opening, "epoch_seconds": epoch}
    row |= {"open_us": 1e6 * opening / count, "epoch_us": 1e6 * epoch / measured["scenes"]}
    if "anonymous_mb" in steps[0]:
        memory = max(step["anonymous_mb"] for step in steps[1:]) - steps[0]["anonymous_mb"]
        row |= {"memory_mb": memory, "memory_kb": 1024 * memory / count}
    return row
