"""`completesplat test`: score a trained model's images against true ones, and its samples against hidden modes."""

import re
import shlex
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypedDict, Unpack

import torch
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track

from completesplat.commands import quieten
from completesplat.commands.jobs import CONFIG, METRICS
from completesplat.commands.protocol import Config, protocol, provenance, sampler_settings
from completesplat.commands.trained import trained_model
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.manifest import is_packed, settings_must_match
from completesplat.errors import CompleteSplatError
from completesplat.files import counted, printable, write_json
from completesplat.quantities import Natural, Positive, Range
from completesplat.results.measured import MODE_COLUMNS, evaluation_table
from completesplat.results.runs import MODEL, read_record
from completesplat.results.tables import records_table, show
from completesplat.settings.schema import EvaluationSettings, TestSettings
from completesplat.training.loggers import wandb_runs
from completesplat.training.scoring import SceneFiles, Scorer
from completesplat.training.stopping import stopped_together

METRIC = re.compile(r"\+*evaluation\.metrics\.(\w+)")


def scored_data(run_config: DictConfig, evaluation: Config) -> SceneDataModule:
    """Return the data of a run's config, with the protocol's changes.

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
            raise CompleteSplatError(f"{chosen}: the data of this run have no setting {key}")
        if value == "???":
            raise CompleteSplatError(f"{chosen} needs evaluation.data.{key}=FILE (fit: or test=false)")
        run_config.data[key] = value
    data: SceneDataModule = instantiate(run_config.data, _convert_="all")
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
    larger.at_model_size = data
    return larger


def set_scoring(module: Scorer, evaluation: Config) -> None:
    """Give a model the protocol's metrics; raise CompleteSplatError if it cannot draw several samples."""
    module.evaluation = instantiate(evaluation["scoring"], _convert_="all")
    if module.evaluation.samples > 1 and not module.draws_samples:
        raise CompleteSplatError("evaluation.scoring.samples: this model draws no samples, it gives one answer")


def built_parts(group: Config | None) -> list[Any]:
    """Build the parts of a config group, without those that are null."""
    return [part for part in instantiate(group or {}, _convert_="all").values() if part is not None]


@stopped_together()
def run(
    evaluation: EvaluationSettings,
    trainer: Config,
    out: Path,
    logger: Config | None = None,
    **trained: Unpack[TestSettings],
) -> None:
    """Write `metrics.json` and print the table.

    Args:
        evaluation, trainer, logger: configs of the protocol, the trainer (without precision), loggers by name.
    """
    tested = trained_model(**trained)
    run_config = tested.configuration()
    quieten()
    seed_everything(tested.seed, verbose=False)
    data = scored_data(run_config, evaluation)
    module = tested.open_module(run_config)
    set_scoring(module, evaluation)
    loggers = built_parts(logger)
    tester: Trainer = instantiate(trainer, precision=evaluation["precision"], logger=loggers, _convert_="all")
    with wandb_runs(loggers, OmegaConf.load(out / CONFIG)):
        tester.test(module, datamodule=data, verbose=False)
        results = module.test_results()
        if not tester.is_global_zero:
            return
        described = protocol(evaluation, module, data, results, out) | tested.facts()
        results = {"protocol": described} | results
        write_json(out / METRICS, results)
    show(evaluation_table(results, label_of(module)), width=160)
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")
    left_out = metrics_left_out(trained["ckpt"], evaluation)
    if left_out:
        print(f"metrics of the run are left out; give them again: {shlex.join(left_out)}")


def label_of(module: Scorer) -> str:
    """Return the name of the tested model in tables: that of a method whose scenes are read from files."""
    return module.method if isinstance(module, SceneFiles) else MODEL


def metrics_left_out(ckpt: str | None, evaluation: Config) -> list[str]:
    """Return the overrides by which a checkpoint's run was given metrics that the evaluation lacks."""
    record = {} if ckpt is None else read_record(Path(ckpt).absolute().parents[1])
    given = map(printable, record.get("overrides", []))
    return [x for x in given if (named := METRIC.match(x)) and named[1] not in evaluation["metrics"]]


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


def run_hidden_modes(
    evaluation: HiddenModesEvaluation,
    trainer: Config,
    out: Path,
    logger: Config | None = None,
    **trained: Unpack[TestSettings],
) -> None:
    """Write JSON files of hidden modes, shares and protocol, draw `hidden_modes.png`, and print the table.

    Args:
        trainer: only its `accelerator` has an effect; "cpu" leaves a GPU alone.

    Raises:
        CompleteSplatError: the data's hidden parts are not known, or no scene can be used.
    """
    from completesplat.studies.mode_benchmark import measure, predictors, usable_scenes, write_modes

    tested = trained_model(**trained)
    quieten()
    module, data = tested.open()
    data.prepare_data()
    data.setup("test")
    device = torch.device("cuda" if trainer["accelerator"] != "cpu" and torch.cuda.is_available() else "cpu")
    module.to(device).eval()
    samples = evaluation["samples"]
    candidates = data.hidden_modes(evaluation["views"], evaluation["spread_views"])
    scenes, skipped = usable_scenes(candidates, evaluation["scenes"])
    if isinstance(module, SceneFiles):
        module.find([scene.scene.names[0] for scene in scenes], samples)
    progress = partial(track, description="Hidden modes", console=Console(stderr=True))
    methods = predictors(module, samples, evaluation["batch"])
    on_device = [scene.to(device) for scene in scenes]
    sheet_sizes = evaluation["shown_scenes"], evaluation["shown_samples"]
    measured = measure(methods, on_device, samples, evaluation["seed"], *sheet_sizes, progress)
    results = measured.results(samples)
    write_json(out / "hidden_modes.json", results)
    write_json(out / "shares.json", measured.shares())
    used_settings = ("name", "samples", "views", "spread_views", "seed")
    settings: dict[str, object] = {key: value for key, value in evaluation.items() if key in used_settings}
    settings |= {"method": module.method, **data.describe(), "image_size": data.image_size, **sampler_settings(module)}
    used = {"scenes": measured.names, "skipped": skipped, **provenance(data, out), **tested.facts()}
    write_json(out / "protocol.json", settings | used)
    write_modes(measured, samples, out / "hidden_modes.png")
    scores = {f"hidden_modes/{method}/{name}": x for method, values in results.items() for name, x in values.items()}
    loggers: list[Logger] = built_parts(logger)
    with wandb_runs(loggers, OmegaConf.load(out / CONFIG)):
        for each in loggers:
            each.log_metrics(scores, step=0)
            each.save()
    title = "Hidden modes (best: coverage 1, the others 0; draws of the truth: true_sampler)"
    labels = {MODEL: label_of(module)}
    records = [{"method": labels.get(name, name), **values} for name, values in results.items()]
    show(records_table(title, records, MODE_COLUMNS), width=140)
    if skipped:
        print(f"{counted(len(skipped), 'scene')} skipped; the first: {skipped[0]}")
