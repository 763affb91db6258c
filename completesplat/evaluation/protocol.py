"""Protocol of a test (`conf/evaluation/`): the data that it scores, its metrics, and its description in results."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from completesplat.data.lists import listed_names
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.manifest import is_packed, settings_must_match
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import provenance
from completesplat.evaluation.records import MODEL
from completesplat.evaluation.scene_scores import BEST_RULES
from completesplat.evaluation.scorer import Scorer
from completesplat.metrics import MetricFormat

Config = Mapping[str, Any]

PACKAGE_METRICS: dict[str, dict[str, object]] = {
    "completesplat.metrics.images.psnr": {
        "range": [0, 1],
        "limit_db": 100,
    },
    "completesplat.metrics.images.ssim": {
        "window": 11,
        "sigma": 1.5,
        "border": "mirrored, counted",
        "range": [0, 1],
    },
    "completesplat.metrics.images.perceptual_metric": {
        "net": "vgg",
        "version": "0.1",
        "range": [-1, 1],
    },
}
"""Settings of the package's image metrics, by the `_target_` of their config."""

BOARD_ENTRIES = ("title", "about", "list", "pictures", "conditions", "published")
"""Entries of a protocol's `board`, which `conf/evaluation/scans.yaml` explains."""


def scored_data(run_config: DictConfig, evaluation: Config) -> SceneDataModule:
    """Return the data of a run's config, with the protocol's changes, which are made in `run_config.data`, too.

    If the protocol scores at a larger size than the model's, the model still sees images of its size.

    Raises:
        CompleteSplatError: the protocol is not for images or for other data, changes a setting that these data lack,
            lacks a file, or scores at a smaller size.
        DataError: the protocol's files cannot be used, or prepared images are smaller than it needs.
    """
    chosen = f"evaluation={evaluation['name']}"
    if "scoring" not in evaluation:
        raise CompleteSplatError(f"{chosen}: fit scores images only; set test=false")
    for key, value in evaluation["data"].items():
        if key not in run_config.data:
            of = "" if evaluation["data_set"] is None else f" is of {evaluation['data_set']}"
            raise CompleteSplatError(f"{chosen}{of}: the data of this run have no setting {key}")
        if value == "???":
            raise CompleteSplatError(f"{chosen} needs evaluation.data.{key}=FILE (fit: or test=false)")
        run_config.data[key] = value
    data: SceneDataModule = instantiate(run_config.data, _convert_="all")
    names = tested_names(evaluation)
    data.tested_names = names
    data_set = str(data.describe()["data_set"])
    if evaluation["data_set"] not in (None, data_set.partition("/")[0]):
        message = f"is of {evaluation['data_set']}, this run's data are {data_set}: use evaluation=images"
        raise CompleteSplatError(f"{chosen} {message}")
    resolution = evaluation["resolution"]
    size = data.image_size
    if resolution is None or resolution == size:
        return data
    if resolution < size:
        raise CompleteSplatError(f"evaluation.resolution={resolution}: below the model's {size}")
    larger: SceneDataModule = instantiate(run_config.data, image_size=resolution, _convert_="all")
    if is_packed(data.root):
        settings_must_match(larger.root, larger.packed_settings())
    larger.tested_names = names
    larger.low_resolution = data
    return larger


def board_of(evaluation: Config) -> Config | None:
    """Return `board` of a protocol, None if it is not on the board; raise CompleteSplatError if an entry is missing."""
    board: Config | None = evaluation.get("board")
    if board is None:
        return None
    missing = [name for name in BOARD_ENTRIES if name not in board]
    if missing:
        raise CompleteSplatError(f"evaluation={evaluation['name']}: board has no {missing[0]}; see scans.yaml")
    return board


def tested_names(evaluation: Config) -> list[str] | None:
    """Return the names of the scenes that a protocol of the board tests; None: all scenes of the data's test."""
    board = board_of(evaluation)
    return None if board is None or board["list"] is None else listed_names(board["list"])


def set_metrics(module: Scorer, evaluation: Config) -> None:
    """Give a model the protocol's metrics, or raise CompleteSplatError if it cannot draw several samples."""
    module.evaluation = instantiate(evaluation["scoring"], _convert_="all")
    if module.evaluation.samples > 1 and not module.draws_samples:
        raise CompleteSplatError("evaluation.scoring.samples: this model draws no samples, it gives one answer")


def describe_test(
    evaluation: Config, module: Scorer, data: SceneDataModule, results: Mapping[str, Any], out: Path
) -> dict[str, Any]:
    """Describe what was measured and how, in a test by a config of `conf/evaluation/` with results in `out`."""
    scores = module.evaluation
    model_size = data if data.low_resolution is None else data.low_resolution
    described: dict[str, Any] = {"name": evaluation["name"], "method": module.method}
    described |= data.describe()
    described["image_size"] = model_size.image_size
    described["resolution"] = data.image_size
    if data.background is not None:
        described["background"] = data.background
    described["precision"] = evaluation["precision"]
    described["scenes_listed"] = data.source("test").listed
    described["scenes"] = results[MODEL]["scenes"]
    described["skipped"] = len(scores.skipped)
    described["views"] = results[MODEL]["views"]
    described["samples"] = scores.samples
    described["criterion"] = scores.criterion
    described["seed"] = scores.seed
    if scores.samples > 1:
        described["best"] = BEST_RULES
    described |= sampler_settings(module)
    if module.fitted_to is not None:
        described["fitted_to"] = module.fitted_to
    described["object_pixels"] = "background black in both, by the true mask cut at 0.5"
    described["average"] = "over the views of a scene, then over scenes"
    described["sharpness"] = "squared differences of neighbours, summed over a scene's novel views, over the truth's"
    metrics = {name: metric_settings(evaluation["metrics"][name], x) for name, x in scores.formats.items()}
    for set_metric in scores.set_metrics:
        metrics |= set_metric.settings()
    described["metrics"] = metrics
    described["missing"] = scores.missing
    return described | provenance(module, data, out)


def metric_settings(config: Mapping[str, object], metric_format: MetricFormat) -> Mapping[str, object]:
    """Return the settings of an image metric that scores depend on.

    Those of a metric that is not the package's are its config and, as `style`, its format in tables.
    """
    return PACKAGE_METRICS.get(str(config["_target_"]), {**config, "style": asdict(metric_format)})


def sampler_settings(module: Scorer) -> dict[str, object]:
    """Return the settings of the sampler, which are None for deterministic models and for scenes from files."""
    controls = ("skip_weight", "guidance_weight", "color_fits")
    model = getattr(module, "completesplat", None)  # modules that draw samples hold their model under this name
    if model is None:
        return dict.fromkeys(("sampler", "steps", *controls))
    described: dict[str, object] = {"sampler": type(model.sampler.scheduler).__name__, "steps": model.sampler.steps}
    for name in controls:
        described[name] = getattr(module, name)
    return described
