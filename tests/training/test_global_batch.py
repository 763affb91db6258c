"""data.batch_size is the batch of an optimizer step, however many processes and accumulated batches share it."""

import os

import pytest
from hydra.utils import instantiate
from support import SMALL, compose_config, refused, strict_json
from torch import distributed

from completesplat.data.loading.distributed import batch_per_process
from completesplat.errors import CompleteSplatError
from completesplat.training.reconstruction import ReconstructionModule

SETTINGS = ["data.image_size=32", "data.references_per_sequence=8"]


def epoch_of(root: str, batch_size: int) -> list[list[tuple[str, int]]]:
    """The scenes (sequence and reference frame) of each batch of this process."""
    config = compose_config("fit", f"data.root={root}", *SETTINGS, f"data.batch_size={batch_size}")
    data = instantiate(config.data, _convert_="all")
    batches = data.train_dataloader()
    return [list(zip(batch.names, batch.reference_frame.tolist(), strict=True)) for batch in batches]


def test_two_processes_share_the_batch(toy_root, monkeypatch):
    alone, shares = epoch_of(str(toy_root), 4), []
    for rank in (0, 1):
        for name, value in (("is_initialized", True), ("get_rank", rank), ("get_world_size", 2)):
            monkeypatch.setattr(distributed, name, lambda value=value: value)
        shares.append(epoch_of(str(toy_root), 4))
    for one, other, whole in zip(*shares, alone, strict=True):  # as many optimizer steps
        assert len(one) == len(other) == 2
        assert sorted(one + other) == sorted(whole)  # of the same scenes


def test_the_share_of_a_process():
    assert [batch_per_process(32, *shared) for shared in ((1, 1), (8, 1), (8, 2))] == [32, 4, 2]
    for shared in ((3, 1), (8, 8)):
        with pytest.raises(CompleteSplatError, match=r"data.batch_size=32 .* must be a multiple of"):
            batch_per_process(32, *shared)


def test_a_batch_that_is_larger_than_an_epoch_is_refused_before_training(toy_root):
    """Its steps would see fewer scenes than the setting says. Two sequences, eight times each."""
    assert [len(batch) for batch in epoch_of(str(toy_root), 16)] == [16]
    config = compose_config("fit", f"data.root={toy_root}", *SETTINGS, "data.batch_size=17").data
    with pytest.raises(CompleteSplatError, match=r"^data\.batch_size=17: an epoch has 16 scenes .* 2 sequences"):
        instantiate(config, _convert_="all").setup("fit")


def test_accumulated_batches_share_the_batch_and_the_share_is_recorded(command, toy_root, tmp_path, monkeypatch):
    counts, step = [], ReconstructionModule.training_step

    def counted(self, scenes, index):
        counts.append(len(scenes.names))
        return step(self, scenes, index)

    monkeypatch.setattr(ReconstructionModule, "training_step", counted)
    settings = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "data.batch_size=4", "test=false"]
    settings += ["trainer.accumulate_grad_batches=2", "callbacks.images=null", "data.references_per_sequence=8"]
    finished = command("fit", *settings, f"out={tmp_path / 'run'}")
    assert finished.status == 0
    assert counts == [2, 2, 2, 2]  # two optimizer steps
    assert strict_json(tmp_path / "run/metrics.json")["data.batch_per_process"] == 2
    assert "data.batch_per_process=2" in (tmp_path / "run/commands.log").read_text()


@pytest.mark.parametrize("variables", [{"LOCAL_RANK": "1", "RANK": "9"}, {"SLURM_STEP_NUM_TASKS": "8"}])
def test_processes_of_a_launcher_need_one_directory(command, monkeypatch, variables):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    finished = command("fit", "experiment=toy_var")
    assert finished.status == 2
    assert "give them one out=DIR" in finished.err.splitlines()[-1]
    assert not os.path.exists("outputs")


def test_a_batch_that_the_devices_do_not_share_is_refused_before_they_start(toy_root):
    settings = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "data.batch_size=3", "rasterizer=reference"]
    line = refused("fit", *settings, "trainer.devices=2", "trainer.strategy=ddp", "out=run")
    assert line.startswith("data.batch_size=3 is the batch of an optimizer step")


def test_launchers_say_how_many_processes_there_are(monkeypatch):
    for name in ("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE", "SLURM_NTASKS_PER_NODE", "SLURM_NNODES"):
        monkeypatch.delenv(name, raising=False)
    trainer = compose_config("fit", "trainer=ddp").trainer
    assert (trainer.devices, trainer.num_nodes) == ("auto", 1)
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", "8")
    monkeypatch.setenv("SLURM_NNODES", "3")
    slurm = compose_config("fit", "trainer=slurm").trainer
    assert (trainer.devices, trainer.num_nodes) == (slurm.devices, slurm.num_nodes) == (8, 3)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setenv("GROUP_WORLD_SIZE", "2")
    assert (trainer.devices, trainer.num_nodes) == (4, 2)
