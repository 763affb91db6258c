"""`completesplat plan`: what a training takes, before it starts."""

import pytest
from omegaconf import OmegaConf
from support import NETWORKS, compose_config, strict_json

from completesplat.commands.plan import (
    Speeds,
    Total,
    count_work,
    loading_seconds,
    parts_beside_steps,
    plan_of,
    precision,
    seconds_of,
    sequences_there,
    speeds_of_gpu,
    steps_of,
)
from completesplat.settings.options import choices_of_verb
from completesplat.training.step_counts import Operation

SMALL = ["experiment=toy_diffusion", "data.image_size=32", *NETWORKS]


@pytest.mark.slow
def test_a_plan_is_printed_and_written_and_a_sweep_ends_in_a_total(command, tmp_path):
    mine = "+gpus.mine={bfloat16: 1e-3, float32: 1, memory: 0.01, bandwidth: 1}"
    swept = command.succeeds("plan", "-m", *SMALL, "gpu=a100,mine", mine, f"out={tmp_path}")
    a100, mine = (strict_json(tmp_path / f"gpu-{name}/plan.json") for name in ("a100", "mine"))
    assert "total" in swept.out
    assert "8,000" in swept.out  # steps of both
    assert a100["fits"]
    assert not mine["fits"]
    assert mine["flops_of_a_step"] == a100["flops_of_a_step"]
    assert mine["parts"]["matrix products"] == pytest.approx(mine["flops_of_a_step"] / (1e9 * 0.4), rel=0.1)
    assert mine["parts"]["waiting for data"] is None
    assert mine["days"] == pytest.approx(4000 * sum(filter(None, mine["parts"].values())) / 86400)
    assert mine["price"] == pytest.approx(2 * mine["gpu_hours"]) == pytest.approx(2 * 24 * mine["days"])
    assert a100["seconds_a_step"] == pytest.approx(8e-6 * a100["operations_of_a_step"], rel=0.01)  # too small a network
    assert "waiting for data, ms a step" in swept.out
    assert "price, USD" in swept.out


def test_a_sweep_into_nested_folders_ends_in_its_total(tmp_path, capsys):
    for gpu in ("a100", "h100"):
        (tmp_path / f"x/{gpu}").mkdir(parents=True)
        (tmp_path / f"x/{gpu}/plan.json").write_text('{"steps": 4000, "days": 2.0}')
    Total().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("x/a100", "x/h100", "8,000"))


@pytest.mark.slow
def test_devices_share_the_batch_and_latents_need_no_encoder():
    one, two = (plan_of(compose_config("plan", *SMALL, f"devices={n}")) for n in (1, 2))
    cached = plan_of(compose_config("plan", *SMALL, "data.latent_cache=LATENTS"))
    assert two["flops_of_a_step"] == pytest.approx(one["flops_of_a_step"], rel=1e-6)
    assert two["activations_GB"] < 0.6 * one["activations_GB"]
    assert two["copies_for_ddp_GB"] == two["gradients_GB"]
    assert (one["copies_for_ddp_GB"], one["averages_GB"]) == (0, one["weights_GB"])
    assert cached["flops_of_a_step"] < one["flops_of_a_step"]
    assert cached["frozen_parameters"] == one["frozen_parameters"]


@pytest.mark.slow
def test_a_batch_that_does_not_fit_is_told_what_makes_it_fit():
    table = "gpus.l40s={bfloat16: 1, float32: 1, memory: %s, bandwidth: 1}"
    whole = plan_of(compose_config("plan", *SMALL))
    half = (whole["memory_GB"] - 0.3 * whole["activations_GB"]) / 0.9
    plan = plan_of(compose_config("plan", *SMALL, "gpu=l40s", table % half))
    assert not plan["fits"]
    assert any("It fits with trainer.accumulate_grad_batches=2" in line for line in plan["remarks"])
    fitting = plan_of(compose_config("plan", *SMALL, "gpu=l40s", table % half, "trainer.accumulate_grad_batches=2"))
    assert fitting["fits"]
    assert fitting["flops_of_a_step"] == pytest.approx(whole["flops_of_a_step"], rel=1e-6)
    none = plan_of(compose_config("plan", *SMALL, "gpu=l40s", table % 0.001))
    assert any("No setting here makes it fit" in line for line in none["remarks"])


def test_this_machine_is_timed_and_what_an_unfinished_folder_lacks_is_assumed(tmp_path):
    (tmp_path / "unfinished").mkdir()
    unfinished = f"data.root={tmp_path / 'unfinished'}"
    plan = plan_of(compose_config("plan", *SMALL, "gpu=this", "data.batch_size=2", unfinished))
    assert (plan["assumptions"]["sequences"], plan["parts"]["waiting for data"]) == (400, None)
    assert plan["seconds_a_step"] > 0
    assert plan["memory_measured_GB"] is None or 0.3 < plan["memory_GB"] / plan["memory_measured_GB"] < 3


def test_an_operation_takes_the_longest_of_its_flops_its_bytes_and_its_start():
    speeds = Speeds(flops=100.0, bandwidth=10.0, start=0.5, drawing=0.0)
    operations = [Operation(200, 10), Operation(50, 30), Operation(0, 40), Operation(0, 1)]
    assert seconds_of(operations, speeds) == {"matrix products": 2, "reads and writes": 7, "starts of operations": 0.5}


def test_a_gpu_of_half_the_flops_draws_half_as_fast():
    config = compose_config("plan", "gpu=mine", "+gpus.mine={bfloat16: 1, float32: 33.5, memory: 1, bandwidth: 1}")
    assert speeds_of_gpu(config).drawing == pytest.approx(2 * 5.8e-9)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["paper_var_stage1", "paper_diffusion"])
def test_the_papers_step_is_beside_ours_where_the_data_are_its(experiment):
    plan = plan_of(compose_config("plan", f"experiment={experiment}", "gpu=a100"))
    paper = {"paper_var_stage1": 6 * 86400 / 322_000, "paper_diffusion": 2 * 86400 / 1_100_000}[experiment]
    assert plan["paper_seconds_a_step"] == pytest.approx(paper, rel=0.01)
    left = [remark for remark in plan["remarks"] if remark.startswith(("The paper's step", "What is left"))]
    assert len(left) == {"paper_var_stage1": 2, "paper_diffusion": 1}[experiment]


def test_data_that_are_here_are_loaded_and_waited_for_if_that_takes_longer(toy_root, tmp_path):
    assert loading_seconds(compose_config("plan", *SMALL, f"data.latent_cache={tmp_path / 'absent'}")) is None
    settings = ["optimizer=adam", "data.batch_size=2", "data.targets=3", "data.workers=2", f"data.root={toy_root}"]
    config = compose_config("plan", "experiment=toy_var", *settings)
    seconds = loading_seconds(config)
    assert 0 < seconds < 10
    counts = count_work(config, 2)
    beside = [parts_beside_steps(config, counts, 2, step, seconds) for step in (0.1 * seconds, 2 * seconds)]
    # Two processes load the two scenes of a step, so it waits for what it does not take itself.
    assert [part["waiting for data"] for part in beside] == [pytest.approx(0.9 * seconds), 0]
    saved = sum(counts.memory[kind] for kind in ("weights", "optimizer"))
    often = 1 / config.callbacks.checkpoint.every_n_train_steps
    assert beside[0]["checkpoints"] == pytest.approx(saved / 0.5e9 * often, rel=0.01)
    # A forward pass is a third of a step, and 8 batches of 4 scenes are 16 batches of 2.
    assert beside[1]["validation"] == pytest.approx(2 * seconds / 3 * 16 / config.trainer.val_check_interval, rel=0.2)
    config.trainer.accumulate_grad_batches = 2  # the interval counts batches, of which two make a step now
    halved = parts_beside_steps(config, count_work(config, 1), 1, 2 * seconds, seconds)
    assert halved["validation"] == pytest.approx(2 * beside[1]["validation"], rel=0.2)
    del config.callbacks  # as `~callbacks`
    assert parts_beside_steps(config, counts, 2, seconds, seconds)["checkpoints"] == 0


def test_an_absent_or_unfinished_folder_of_data_has_no_sequences(toy_root, tmp_path, caplog):
    (tmp_path / "unfinished").mkdir()
    for name in ("absent", "unfinished"):
        config = compose_config("plan", "experiment=toy_var", f"data.root={tmp_path / name}")
        assert sequences_there(config.data) is None
    assert len(caplog.messages) == 1
    assert "unfinished/toy_objects: no such CO3D category; the plan is made as if" in caplog.text
    assert sequences_there(compose_config("plan", "experiment=toy_var", f"data.root={toy_root}").data) > 0


def test_epochs_of_the_papers_data_are_the_papers_steps():
    config = compose_config("plan", "experiment=paper_var_stage1")
    assert steps_of(config, 723) == 138_000
    assert steps_of(config, 1329) == 252_000
    assert precision(config) == "bf16-mixed"
    assert precision(compose_config("plan", "trainer.precision=32-true")) == "32-true"


def test_it_takes_what_fit_takes():
    assert choices_of_verb("plan") == choices_of_verb("fit")
