"""data.batch_size is the batch of an optimizer step, however many processes and accumulated batches share it."""

import os
from functools import partial
from itertools import accumulate

import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import BatchSizeFinder
from scenes_for_training import opened, quiet_trainer, scene_batch
from support import SMALL, compose_config, refused, strict_json
from torch import distributed, nn

from completesplat.data.loading.distributed import batch_per_process
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.training.optimization import constant
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage

SETTINGS = ["data.image_size=32", "data.references_per_sequence=8"]


def epoch_of(root: str, batch_size: int) -> list[list[tuple[str, int]]]:
    """The scenes (sequence and reference frame) of each batch of this process."""
    config = compose_config("fit", f"data.root={root}", *SETTINGS, f"data.batch_size={batch_size}")
    data = instantiate(config.data, _convert_="all")
    batches = data.train_dataloader()
    return [list(zip(batch.names, batch.reference_frame.tolist(), strict=True)) for batch in batches]


def test_two_processes_share_the_batch(toy_root, monkeypatch):
    alone = epoch_of(str(toy_root), 4)
    shares = []
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
    counts = []
    step = ReconstructionModule.training_step

    def counted(self, scenes, index):
        counts.append(len(scenes.names))
        return step(self, scenes, index)

    monkeypatch.setattr(ReconstructionModule, "training_step", counted)
    settings = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "data.batch_size=4", "test=false"]
    settings += ["trainer.accumulate_grad_batches=2", "callbacks.images=null", "data.references_per_sequence=8"]
    command.succeeds("fit", *settings, f"out={tmp_path / 'run'}")
    assert counts == [2, 2, 2, 2]  # two optimizer steps
    assert strict_json(tmp_path / "run/metrics.json")["data.batch_per_process"] == 2
    assert "data.batch_per_process=2" in (tmp_path / "run/commands.log").read_text()


@pytest.mark.parametrize("variables", [{"LOCAL_RANK": "1", "RANK": "9"}, {"SLURM_STEP_NUM_TASKS": "8"}])
def test_processes_of_a_launcher_need_one_directory(command, monkeypatch, variables):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert "give them one out=DIR" in command.refuses("fit", "experiment=toy_var")
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


class MeanOfScenes(Stage):
    """One weight, whose gradient is the mean of the scenes' images, because the loss is the weight times that mean."""

    def __init__(self) -> None:
        super().__init__(ReferenceRasterizer(), partial(torch.optim.SGD, lr=1.0), constant)
        self.weight = nn.Parameter(torch.zeros(()))
        self.path = []

    def reconstruct(self, scenes, seed):
        raise NotImplementedError

    def training_step(self, batch, index):
        return self.weight * batch.reference.images.mean()

    def on_train_batch_end(self, *_):
        self.path.append(self.weight.item())


@pytest.mark.parametrize("scenes", [8, 16, 17, 19, 20])
@pytest.mark.parametrize("limit", [1.0, 5])
def test_accumulated_batches_step_as_their_scenes_in_one_batch_also_at_an_epochs_end(scenes, limit, tmp_path):
    """In closed form: a step of plain SGD moves the weight by minus the mean of the step's scenes."""
    batch = scene_batch(scenes, size=8)
    numbers = batch.reference.images.mean((1, 2, 3)).tolist()
    batches = [batch[i : i + 2] for i in range(0, scenes, 2)]
    module = MeanOfScenes()
    settings = {"limit_train_batches": limit, "default_root_dir": tmp_path}
    trainer = quiet_trainer(max_epochs=2, accumulate_grad_batches=4, **settings)
    trainer.fit(module, torch.utils.data.DataLoader(batches, batch_size=None, collate_fn=lambda batch: batch))
    seen = numbers if limit == 1.0 else numbers[: 2 * limit]
    steps = [-sum(seen[i : i + 8]) / len(seen[i : i + 8]) for i in range(0, len(seen), 8)] * 2
    assert trainer.global_step == len(steps)
    assert [path for path in dict.fromkeys(module.path) if path] == pytest.approx(list(accumulate(steps)))


def test_an_epoch_of_accumulated_batches_trains_as_whole_batches(toy_root, tmp_path):
    """Six scenes in batches of four, by plain SGD: one step of four scenes, and one of two."""
    given = ["data.batch_size=4", "ablation=no_variational", "data.references_per_sequence=3"]
    given += ["optimizer=adam", "optimizer._target_=torch.optim.SGD", "optimizer.lr=1"]
    trained = []
    for accumulated in (1, 2):
        torch.manual_seed(0)
        data, module = opened(toy_root, *given)
        trainer = quiet_trainer(max_epochs=1, accumulate_grad_batches=accumulated, limit_val_batches=0)
        trainer.fit(module, data)
        assert trainer.global_step == 2
        trained.append(torch.cat([parameter.detach().flatten() for parameter in module.parameters()]))
    torch.testing.assert_close(*trained, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["power", "binsearch"])
def test_lightnings_search_for_a_batch_size_ends_at_the_scenes_of_an_epoch(toy_root, tmp_path, mode):
    data, module = opened(toy_root, "data.references_per_sequence=5")
    finder = BatchSizeFinder(mode, steps_per_trial=1, **({"margin": 0.0} if mode == "binsearch" else {}))
    trainer = quiet_trainer(max_steps=1, callbacks=[finder], limit_val_batches=0, default_root_dir=tmp_path)
    trainer.fit(module, data)
    assert finder.optimal_batch_size == data.batch_size == 10  # five of each of two sequences
    assert list(tmp_path.iterdir()) == []
