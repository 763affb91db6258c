"""`completesplat test`: scores of a trained model's images, as `fit` computes them, too, and of hidden modes."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypedDict

import torch
from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track

from completesplat.commands import quieten
from completesplat.commands.jobs import CONFIG, METRICS
from completesplat.commands.protocol import drawing, protocol, provenance, write_json
from completesplat.commands.trained import Trained
from completesplat.data.hidden_modes import hidden_modes
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.manifest import is_packed, settings_must_match
from completesplat.errors import CompleteSplatError
from completesplat.results.tables import Column, evaluation_table, show, table
from completesplat.results.wandb import begin, log_modes, log_shown
from completesplat.settings.schema import Natural, Positive, Range
from completesplat.training.loggers import finished
from completesplat.training.stage import Stage
from completesplat.training.stopping import stopped_together


class ScoringProtocol(TypedDict):
    """A protocol of scores of images; `conf/evaluation/images.yaml` explains each entry."""

    name: str
    data_set: str | None
    data: Mapping[str, object]
    resolution: Positive | None
    precision: str
    scoring: Mapping[str, object]


def scored_data(run_config: DictConfig, evaluation: ScoringProtocol) -> SceneDataModule:
    """Return the data of a run's config, after the changes that the protocol makes to it.

    If the protocol scores at a larger size than the model's, the model still sees the data at its size.

    Raises:
        CompleteSplatError: the protocol does not score images, is for other data, changes a setting that these data do
            not have, lacks a file, or scores at a smaller size.
        DataError: the protocol's files cannot be used, or prepared images are smaller than it needs.
    """
    chosen = f"evaluation={evaluation['name']}"
    if "scoring" not in evaluation:
        raise CompleteSplatError(f"{chosen}: fit scores images only; set test=false")
    for key, value in evaluation["data"].items():
        if key not in run_config.data:
            raise CompleteSplatError(f"{chosen}: the data of this run have no setting {key}")
        if value == "???":
            raise CompleteSplatError(f"{chosen} needs evaluation.data.{key}=FILE (fit: or test=false)")
        run_config.data[key] = value
    data: SceneDataModule = instantiate(run_config.data, _convert_="all")
    data_set = str(data.describe()["data_set"])
    if evaluation["data_set"] is not None and data_set.partition("/")[0] != evaluation["data_set"]:
        message = f"{chosen} is of {evaluation['data_set']}, this run's data are {data_set}: use evaluation=images"
        raise CompleteSplatError(message)
    resolution, size = evaluation["resolution"], data.image_size
    if resolution is None or resolution == size:
        return data
    if resolution < size:
        raise CompleteSplatError(f"evaluation.resolution={resolution}: below the model's {size}")
    larger: SceneDataModule = instantiate(run_config.data, image_size=resolution, _convert_="all")
    if is_packed(data.root):
        settings_must_match(larger.root, larger.packed_settings())
    larger.at_model_size = data
    return larger


def set_scoring(module: Stage, evaluation: ScoringProtocol) -> None:
    """Set the protocol's metrics in a model.

    Raises:
        CompleteSplatError: the protocol has several samples, and the model gives one answer.
    """
    module.evaluation = instantiate(evaluation["scoring"], _convert_="all")
    if module.evaluation.samples > 1 and not module.draws_samples:
        raise CompleteSplatError("evaluation.scoring.samples: this model draws no samples, it gives one answer")


@stopped_together()
def run(
    trained: Mapping[str, Any],
    evaluation: ScoringProtocol,
    trainer: Mapping[str, object],
    logger: Mapping[str, object] | None,
    out: Path,
) -> None:
    """Write `metrics.json` and print the table.

    Args:
        trained: arguments of `Trained`.
        evaluation, trainer, logger: configs of the protocol, of the trainer (without precision), of loggers by name.
    """
    tested = Trained(**trained)
    run_config = tested.configuration()
    quieten()
    seed_everything(tested.seed, verbose=False)
    data = scored_data(run_config, evaluation)
    module = tested.open_module(run_config)
    set_scoring(module, evaluation)
    loggers = list(instantiate(logger or {}, _convert_="all").values())
    testing = instantiate(trainer, precision=evaluation["precision"], logger=loggers, _convert_="all")
    with finished(loggers):
        shown = begin(module, testing, OmegaConf.load(out / CONFIG), out)
        testing.test(module, datamodule=data, verbose=False)
        results = module.test_results()
        if not testing.is_global_zero:
            return
        described = protocol(evaluation, module, data, results, out) | tested.facts()
        write_json(out / METRICS, {"protocol": described} | results)
        log_shown(results, shown, testing, out)
    show(evaluation_table(results))
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")


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


def run_hidden_modes(
    trained: Mapping[str, Any],
    evaluation: HiddenModesEvaluation,
    trainer: Mapping[str, object],
    logger: Mapping[str, object] | None,
    out: Path,
) -> None:
    """Write `hidden_modes.json` and `.png`, `shares.json`, `calibration.json`, `protocol.json`, and print the table.

    The arguments are those of `run`. Only the `accelerator` of `trainer` is used: "cpu" leaves a GPU alone.

    Raises:
        CompleteSplatError: the hidden parts of the data are not known, or no scene can be used.
    """
    from completesplat.studies.mode_benchmark import draw, measure, predictors, usable

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
    methods = predictors(module, samples, evaluation["batch"])
    shown = evaluation["shown_scenes"], evaluation["shown_samples"]
    scenes = [scene.to(device) for scene in scenes]
    measured = measure(methods, scenes, samples, evaluation["seed"], *shown, progress)
    results, calibration = measured.results(samples), measured.calibration()
    write_json(out / "hidden_modes.json", results)
    write_json(out / "calibration.json", calibration)
    write_json(out / "shares.json", measured.shares())
    used = {"scenes": measured.names, "skipped": skipped}
    write_json(out / "protocol.json", _hidden_modes_protocol(tested, evaluation, module, data, used, out))
    draw(measured.shown, results, calibration, samples, out / "hidden_modes.png")
    loggers = list(instantiate(logger or {}, _convert_="all").values())
    with finished(loggers):
        log_modes(results, out / "hidden_modes.png", OmegaConf.load(out / CONFIG), loggers)
    title = "Hidden modes (best: coverage 1, the others 0; true_sampler draws from the true distribution)"
    rows = [{"method": method, **scores} for method, scores in results.items()]
    Console(width=140).print(table(title, COLUMNS, rows))
    if skipped:
        print(f"{len(skipped)} scenes skipped; the first: {skipped[0]}")


def _hidden_modes_protocol(
    tested: Trained,
    evaluation: HiddenModesEvaluation,
    module: Stage,
    data: SceneDataModule,
    scenes: Mapping[str, Sequence[str]],
    out: Path,
) -> dict[str, object]:
    """Return the description of what was measured and how, with the names of the scenes."""
    return {
        "name": evaluation["name"],
        "method": module.method,
        **data.describe(),
        "image_size": data.image_size,
        **scenes,
        "samples": evaluation["samples"],
        "views": evaluation["views"],
        "spread_views": evaluation["spread_views"],
        "seed": evaluation["seed"],
        **drawing(module),
        **provenance(data, out),
        **tested.facts(),
    }
