"""`fit debug=default|overfit|profiler`, typed in an empty folder."""

import json

import pytest
from omegaconf import OmegaConf
from small_runs import rows
from support import SMALL

from completesplat.settings.help import help_page

GIVEN = ["fit", "experiment=toy_var", *[setting for setting in SMALL if not setting.startswith("trainer.")], "out=RUN"]
SEEN = '''
from pathlib import Path
from lightning import Callback

class Seen(Callback):
    """Notes the first colour of each training batch."""
    def on_train_batch_start(self, trainer, module, batch, index):
        with Path("seen.txt").open("a") as file:
            file.write(f"{batch.names} {batch.reference.images.sum().item()}\\n")
'''


def test_the_default_is_a_few_steps_on_the_cpu_that_are_all_logged(command, toy_root, tmp_path):
    command.succeeds(*GIVEN, f"data.root={toy_root}", "debug=default", "trainer.max_steps=2")
    config = OmegaConf.load(tmp_path / "RUN/config.yaml")
    trainer = config.trainer
    assert (trainer.accelerator, trainer.devices, trainer.detect_anomaly) == ("cpu", 1, True)
    assert (config.test, config.data.workers, trainer.val_check_interval) == (False, 0, 5)
    assert json.loads((tmp_path / "RUN/run.json").read_text())["groups"]["debug"] == "default"
    assert [row["step"] for row in rows(tmp_path / "RUN") if row["train/mse"]][:2] == ["0", "1"]
    assert "test" not in json.loads((tmp_path / "RUN/metrics.json").read_text())


def test_the_default_ends_at_the_first_gradient_that_is_not_finite(command, toy_root):
    rates = ["optimizer.lr=1e20", "optimizer.adam_lr=1e20", "schedule=constant"]
    with pytest.warns(UserWarning, match="Error detected in"), pytest.raises(RuntimeError, match="returned nan values"):
        command(*GIVEN, f"data.root={toy_root}", "debug=default", *rates)


def test_overfit_sees_one_batch(command, toy_root, tmp_path):
    (tmp_path / "seeing.py").write_text(SEEN)
    seen = [
        "+callbacks.seen._target_=seeing.Seen",
        "data.batch_size=1",
        "trainer.max_steps=6",
        "trainer.accelerator=cpu",
    ]
    command.succeeds(*GIVEN, f"data.root={toy_root}", "debug=overfit", *seen)
    lines = (tmp_path / "seen.txt").read_text().splitlines()
    assert (len(lines), len(set(lines))) == (6, 1)
    assert OmegaConf.load(tmp_path / "RUN/config.yaml").trainer.overfit_batches == 1


def test_the_profiler_writes_its_table_into_the_folder_of_the_run(command, toy_root, tmp_path):
    short = ["trainer.max_steps=2", "trainer.accelerator=cpu"]
    command.succeeds(*GIVEN, f"data.root={toy_root}", "debug=profiler", *short)
    table = (tmp_path / "RUN/fit-profile.txt").read_text()
    (line,) = [line for line in table.splitlines() if "run_training_batch" in line]
    assert int(line.split("|")[3]) == 2


def test_help_shows_what_each_option_changes():
    page = help_page("fit")
    assert "debug=default: Ten steps" in page
    for change in ("trainer.detect_anomaly=true", "trainer.overfit_batches=1", "trainer.profiler.filename=profile"):
        assert change in page
    assert "hydra/sweeper=optuna" in page
    assert "hydra.sweeper.n_trials=20" in page
