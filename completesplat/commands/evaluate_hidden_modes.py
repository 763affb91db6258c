"""`completesplat test evaluation=hidden_modes`: samples of what the reference view hides, against the known truth."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError

LEAST = {"samples": 2, "views": 1, "spread_views": 0, "shown_scenes": 1, "shown_samples": 1, "batch": 1, "seed": 0}
COLUMNS = [
    ("method", "method", ""),
    ("coverage", "coverage", ".3f"),
    ("total variation", "total_variation", ".3f"),
    ("sharpness", "sharpness", ".3f"),
    ("rejected", "rejected", ".3f"),
    ("scenes", "scenes", "d"),
    ("samples", "samples", "d"),
]


def run(config: Any, out: Path) -> None:
    """Write `hidden_modes.json`, `calibration.json`, `protocol.json` and `hidden_modes.png`, and print the table.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing or does not fit.
        CompleteSplatError: data whose hidden parts are not known, a number too small, or no scene that can be used.
    """
    import torch
    from hydra.utils import instantiate
    from rich.console import Console
    from rich.progress import track

    from completesplat.data.hidden_modes import hidden_modes
    from completesplat.results.wandb import log_modes
    from completesplat.studies.hidden_modes import draw, measure, predictors, usable
    from completesplat.training.loggers import finished

    asked = config.evaluation
    _check(asked)
    module, data = open_run(config)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    module.to(device).eval()
    scenes = hidden_modes(data, asked.views, asked.spread_views)
    count = len(scenes) if asked.scenes is None else min(asked.scenes, len(scenes))
    shown = track(usable(scenes, count), "Hidden modes", count, console=Console(stderr=True))
    found = (scene if isinstance(scene, Exception) else scene.to(device) for scene in shown)
    methods = predictors(module, asked.samples, asked.batch)
    measured = measure(methods, found, asked.samples, asked.seed, asked.shown_scenes, asked.shown_samples)
    results, calibration = measured.results(asked.samples), measured.calibration()
    _write(out / "hidden_modes.json", results)
    _write(out / "calibration.json", calibration)
    _write(out / "protocol.json", protocol(config, module, data, measured))
    draw(measured.shown["model"], results, calibration, asked.samples, out / "hidden_modes.png")
    loggers = list(instantiate(config.get("logger", {}), _convert_="all").values())
    with finished(loggers):
        log_modes(results, out / "hidden_modes.png", config, loggers)
    _print(results, measured.skipped)


def protocol(config: Any, module: Any, data: Any, measured: Any) -> dict[str, Any]:
    """What was measured and how, as beside the results of other tests, with the scenes by name."""
    from completesplat import __version__
    from completesplat.commands.protocol import drawing, git_commit
    from completesplat.commands.trained import facts
    from completesplat.results.machine import machine

    asked = config.evaluation
    return {
        "name": asked.name,
        "method": module.method,
        **data.describe(),
        "image_size": data.image_size,
        "scenes": measured.names,
        "skipped": measured.skipped,
        **{key: asked[key] for key in ("samples", "views", "spread_views", "seed")},
        **drawing(module),
        "data_fingerprint": data.source("test").fingerprint(),
        **{"version": __version__, "commit": git_commit(), "command": " ".join(sys.argv)},
        "machine": machine(),
        **facts(config),
    }


def open_run(config: Any) -> tuple[Any, Any]:
    """Model and data, the data made and set up for the test; see `completesplat.commands.trained`.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing or does not fit.
    """
    from hydra.utils import instantiate

    from completesplat.commands import quieten
    from completesplat.commands.trained import configuration, open_module

    run_config = configuration(config)
    quieten()
    data = instantiate(run_config.data, _convert_="all")
    module = open_module(config, run_config)
    data.prepare_data()
    data.setup("test")
    return module, data


def _check(asked: Any) -> None:
    for name, least in LEAST.items():
        if asked[name] < least:
            raise CompleteSplatError(f"evaluation.{name}={asked[name]}: must be at least {least}")
    if asked.scenes is not None and asked.scenes < 1:
        raise CompleteSplatError(f"evaluation.scenes={asked.scenes}: must be at least 1, or null for all")


def _print(results: dict[str, Any], skipped: Sequence[str]) -> None:
    from rich.console import Console

    from completesplat.results.tables import table

    rows = [{"method": method, **found} for method, found in results.items()]
    title = "Hidden modes (best: coverage 1, the others 0; draws of the truth: true_sampler)"
    Console(width=120).print(table(title, COLUMNS, rows))
    if skipped:
        print(f"{len(skipped)} scenes skipped; the first: {skipped[0]}")


def _write(path: Path, results: dict[str, Any]) -> None:
    path.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
