"""`completesplat test`: images of a trained model against true ones; `fit` scores in the same way."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import OmegaConf

from completesplat.commands import quieten
from completesplat.commands.jobs import CONFIG, METRICS
from completesplat.commands.protocol import protocol, write_json
from completesplat.commands.trained import Trained
from completesplat.data.packed.manifest import is_packed
from completesplat.errors import CompleteSplatError
from completesplat.results.tables import evaluation_table, show
from completesplat.results.wandb import begin, log_test
from completesplat.training.loggers import finished


def scored_data(run_config: Any, evaluation: Mapping[str, Any]) -> Any:
    """The data of a run's settings, which are changed as the protocol says.

    Where it scores at a larger size than the model's, the model sees what the data give at its own size.

    Raises:
        CompleteSplatError: the protocol is of no pictures or of other data, changes a setting that these data have not
            got, or scores at a smaller size, or at another one than that of prepared pictures.
        DataError: the protocol's files cannot be used.
    """
    chosen = f"evaluation={evaluation['name']}"
    if "scoring" not in evaluation:
        raise CompleteSplatError(f"{chosen}: fit scores pictures only; set test=false")
    for key, value in evaluation["data"].items():
        if key not in run_config.data:
            raise CompleteSplatError(f"{chosen}: the data of this run have no setting {key}")
        run_config.data[key] = value
    data = instantiate(run_config.data, _convert_="all")
    found = data.describe()["data_set"]
    if evaluation["data_set"] is not None and found.partition("/")[0] != evaluation["data_set"]:
        said = f"is of {evaluation['data_set']}, this run's data are {found}: use evaluation=images"
        raise CompleteSplatError(f"{chosen} {said}")
    resolution, size = evaluation["resolution"], data.image_size
    if resolution is None or resolution == size:
        return data
    if resolution < size:
        raise CompleteSplatError(f"evaluation.resolution={resolution}: below the model's {size}")
    if is_packed(data.root):
        said = f"evaluation.resolution={resolution}: prepared pictures have one size"
        raise CompleteSplatError(f"{said}; give the data as they were published (data.root)")
    larger = instantiate(run_config.data, image_size=resolution, _convert_="all")
    larger.at_model_size = data
    return larger


def set_scoring(module: Any, evaluation: Mapping[str, Any]) -> None:
    """Give a model the protocol's metrics.

    Raises:
        CompleteSplatError: the protocol has several samples, the model gives one answer.
    """
    module.evaluation = instantiate(evaluation["scoring"], _convert_="all")
    if module.evaluation.samples > 1 and not module.draws_samples:
        raise CompleteSplatError("evaluation.scoring.samples: this model draws no samples, it gives one answer")


def run(
    trained: Mapping[str, Any],
    evaluation: Mapping[str, Any],
    trainer: Mapping[str, Any],
    logger: Mapping[str, Any] | None,
    out: Path,
) -> None:
    """Write `metrics.json` and print the table.

    Args:
        trained: the arguments of `Trained`.
        evaluation, trainer, logger: configurations of the protocol, the trainer (without precision), loggers by name.

    Raises:
        CompleteSplatError: model, data and protocol do not go together, or some of them are missing.
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
        described = protocol(evaluation, module, data, results) | tested.facts()
        write_json(out / METRICS, {"protocol": described} | results)
        log_test(results, shown, testing, out)
    show(evaluation_table(results))
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")
