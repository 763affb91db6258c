"""`completesplat test`: images of a trained model against true ones."""

import json
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write `metrics.json` and print the table."""
    from hydra.utils import instantiate
    from lightning import seed_everything

    from completesplat.commands import quieten
    from completesplat.commands.protocol import protocol
    from completesplat.commands.trained import configuration, facts, open_module
    from completesplat.reports.dashboard.logging import begin, log_test
    from completesplat.reports.evaluation_table import evaluation_table, show
    from completesplat.training.wandb_run import finished

    run_config = configuration(config)
    model_size = set_up_data(run_config, config.evaluation)
    quieten()
    seed_everything(config.seed, verbose=False)
    data = instantiate(run_config.data, _convert_="all")
    check_data(data, config.evaluation)
    module = open_module(config, run_config)
    module.evaluation = instantiate(config.evaluation.scoring, model_size=model_size, _convert_="all")
    loggers = list(instantiate(config.get("logger", {}), _convert_="all").values())
    trainer = instantiate(config.trainer, logger=loggers, _convert_="all")
    with finished(loggers):
        shown = begin(module, trainer, config, out)
        trainer.test(module, datamodule=data, verbose=False)
        results = module.test_results()
        if not trainer.is_global_zero:
            return
        described = protocol(config.evaluation.name, module, data, results) | facts(config)
        text = json.dumps({"protocol": described} | results, indent=2, allow_nan=False)
        (out / "metrics.json").write_text(text + "\n")
        log_test(results, shown, trainer, out)
    show(evaluation_table(results))
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")


def set_up_data(run_config: Any, evaluation: Any) -> int | None:
    """Change the run's data settings to the protocol's.

    Returns:
        The side of the model's pictures, if the protocol scores at a larger size.

    Raises:
        CompleteSplatError: a setting that these data have not got, or a smaller size.
    """
    for key, value in evaluation.data.items():
        if key not in run_config.data:
            raise CompleteSplatError(f"evaluation={evaluation.name}: the data of this run have no setting {key}")
        run_config.data[key] = value
    size = run_config.data.image_size
    if evaluation.resolution is None or evaluation.resolution == size:
        return None
    if evaluation.resolution < size:
        raise CompleteSplatError(f"evaluation.resolution={evaluation.resolution}: below the model's {size}")
    run_config.data.image_size = evaluation.resolution
    return size


def check_data(data: Any, evaluation: Any) -> None:
    """Refuse a protocol that is of other data.

    Raises:
        CompleteSplatError: it is.
    """
    found = data.describe()["data_set"]
    if evaluation.data_set is not None and found.partition("/")[0] != evaluation.data_set:
        raise CompleteSplatError(
            f"evaluation={evaluation.name} is of {evaluation.data_set}, this run's data are {found}: "
            "use evaluation=images"
        )
