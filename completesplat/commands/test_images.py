"""`completesplat test`: images of a trained model against true ones."""

import json
from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Write `metrics.json` and print the table."""
    from hydra.utils import instantiate
    from lightning import seed_everything

    from completesplat.commands import quieten
    from completesplat.commands.protocol import protocol
    from completesplat.commands.scoring import scored_data, scoring_trainer, set_scoring
    from completesplat.commands.trained import configuration, facts, open_module
    from completesplat.reports.dashboard.logging import begin, log_test
    from completesplat.reports.evaluation_table import evaluation_table, show
    from completesplat.training.wandb_run import finished

    run_config = configuration(config)
    quieten()
    seed_everything(config.seed, verbose=False)
    data = scored_data(run_config, config.evaluation)
    module = open_module(config, run_config)
    set_scoring(module, config.evaluation)
    loggers = list(instantiate(config.get("logger", {}), _convert_="all").values())
    trainer = scoring_trainer(config, logger=loggers)
    with finished(loggers):
        shown = begin(module, trainer, config, out)
        trainer.test(module, datamodule=data, verbose=False)
        results = module.test_results()
        if not trainer.is_global_zero:
            return
        described = protocol(config.evaluation, module, data, results) | facts(config)
        text = json.dumps({"protocol": described} | results, indent=2, allow_nan=False)
        (out / "metrics.json").write_text(text + "\n")
        log_test(results, shown, trainer, out)
    show(evaluation_table(results))
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")
