"""`completesplat bench`: timings, side by side in one process."""

import json
from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Time the rasterizer backends, write `rasterizers.json`, print the table."""
    from completesplat.reports import evaluation_table, rasterizer_bench

    results = rasterizer_bench.run(list(config.sizes), list(config.views), config.repeats, list(config.backends))
    (out / "rasterizers.json").write_text(json.dumps(results, indent=2) + "\n")
    evaluation_table.show(rasterizer_bench.table(results))
