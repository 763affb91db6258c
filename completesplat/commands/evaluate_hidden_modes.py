"""`completesplat test evaluation=hidden_modes`: samples of what the reference view hides, against the known truth."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypedDict

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import track

from completesplat.commands import quieten
from completesplat.commands.jobs import CONFIG
from completesplat.commands.protocol import drawing, provenance, write_json
from completesplat.commands.schema import Natural, Positive, Range
from completesplat.commands.trained import Trained
from completesplat.data.hidden_modes import hidden_modes
from completesplat.results.tables import Column, table
from completesplat.results.wandb import log_modes
from completesplat.studies.mode_benchmark import draw, measure, predictors, usable
from completesplat.training.loggers import finished


class HiddenModesEvaluation(TypedDict):
    """Numbers of samples, scenes and views; `conf/evaluation/hidden_modes.yaml` explains each."""

    name: str
    samples: Annotated[int, Range(2)]
    scenes: Positive | None
    views: Positive
    spread_views: Natural
    shown_scenes: Positive
    shown_samples: Positive
    batch: Positive
    seed: Natural


FORMATS = {"method": "", **dict.fromkeys(("coverage", "total_variation", "sharpness", "rejected"), ".3f")}
FORMATS |= dict.fromkeys(("energy_hidden", "energy_visible"), ".4f")
FORMATS |= {"scenes": "d", "samples": "d"}
COLUMNS: list[Column] = [(name.replace("_", " "), name, form) for name, form in FORMATS.items()]


def run(
    trained: Mapping[str, Any],
    evaluation: HiddenModesEvaluation,
    trainer: Mapping[str, Any],
    logger: Mapping[str, Any] | None,
    out: Path,
) -> None:
    """Write `hidden_modes.json`, `calibration.json`, `protocol.json` and `hidden_modes.png`, and print the table.

    Args: as those of `evaluate.run`; of `trainer` only the `accelerator` counts: "cpu" leaves a GPU alone.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing or does not fit.
        CompleteSplatError: data whose hidden parts are not known, or no scene that can be used.
    """
    tested = Trained(**trained)
    quieten()
    module, data = tested.open()
    data.prepare_data()
    data.setup("test")
    device = torch.device("cuda" if trainer["accelerator"] != "cpu" and torch.cuda.is_available() else "cpu")
    module.to(device).eval()
    samples = evaluation["samples"]
    scenes, skipped = usable(hidden_modes(data, evaluation["views"], evaluation["spread_views"]), evaluation["scenes"])
    progress = partial(track, description="Hidden modes", console=Console(stderr=True))
    measured = measure(
        predictors(module, samples, evaluation["batch"]),
        [scene.to(device) for scene in scenes],
        samples,
        evaluation["seed"],
        evaluation["shown_scenes"],
        evaluation["shown_samples"],
        progress,
    )
    results, calibration = measured.results(samples), measured.calibration()
    write_json(out / "hidden_modes.json", results)
    write_json(out / "calibration.json", calibration)
    used = {"scenes": measured.names, "skipped": skipped}
    write_json(out / "protocol.json", protocol(tested, evaluation, module, data, used))
    draw(measured.shown, results, calibration, samples, out / "hidden_modes.png")
    loggers = list(instantiate(logger or {}, _convert_="all").values())
    with finished(loggers):
        log_modes(results, out / "hidden_modes.png", OmegaConf.load(out / CONFIG), loggers)
    title = "Hidden modes (best: coverage 1, the others 0; draws of the truth: true_sampler)"
    Console(width=140).print(table(title, COLUMNS, [{"method": method, **found} for method, found in results.items()]))
    if skipped:
        print(f"{len(skipped)} scenes skipped; the first: {skipped[0]}")


def protocol(
    tested: Trained, evaluation: Mapping[str, Any], module: Any, data: Any, scenes: dict[str, list[str]]
) -> dict[str, Any]:
    """The statement of what was measured and how, with the names of the scenes."""
    return {
        "name": evaluation["name"],
        "method": module.method,
        **data.describe(),
        "image_size": data.image_size,
        **scenes,
        **{key: evaluation[key] for key in ("samples", "views", "spread_views", "seed")},
        **drawing(module),
        **provenance(data),
        **tested.facts(),
    }
