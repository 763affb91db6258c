"""Counts of a step against a hand count, and steps of the paper's size on fake tensors, of the CPU and of a GPU."""

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from support import NETWORKS, compose_config
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from completesplat.commands.plan import count_work, without_weights
from completesplat.training import step_counts
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.optimization import constant
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, synthetic_batch

SIZE, BATCH = 16, 3
PAPER = ("paper_var_stage1", "paper_var_stage2", "paper_diffusion", "paper_diffusion_masked")
SLOW = [pytest.param(experiment, marks=pytest.mark.slow) for experiment in PAPER if experiment != "paper_var_stage2"]


class TwoLayers(Stage):
    """3 -> 8 channels by 3 x 3, 8 -> 4 by 1 x 1."""

    def __init__(self) -> None:
        super().__init__(step_counts.MemoryOnlyRasterizer(gpu=True), torch.optim.Adam, constant)
        self.layers = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.Conv2d(8, 4, 1))
        self.frozen = nn.Linear(5, 1).requires_grad_(False)

    def reconstruct(self, scenes, seed):
        raise NotImplementedError

    def training_step(self, batch, index):
        return self.layers(batch.reference.images).mean()


def test_counts_are_those_by_hand() -> None:
    pixels = BATCH * SIZE**2
    first, second = 2 * 3 * 8 * 9 * pixels, 2 * 8 * 4 * pixels  # images have no gradient, the first layer's output has
    counts = step_counts.count_step(TwoLayers, SIZE, BATCH, 0, "32-true", accumulated=2)
    assert counts.flops == 2 * (2 * first + 3 * second)
    assert (counts.trained, counts.frozen) == (8 * 27 + 8 + 4 * 8 + 4, 6)
    weights, images, between, last = 8 * 27 + 8 + 4 * 8 + 4, 3 * pixels, 8 * pixels, 4 * pixels
    moved = images + between + between + last + weights + last + 1  # both layers, and the mean
    assert sum(operation.bytes for operation in counts.forward) == 4 * moved
    assert counts.operations == 2 * (counts.forward + counts.backward) + counts.update
    kinds = counts.memory
    assert (kinds["weights"], kinds["gradients"]) == (4 * (counts.trained + 6), 4 * counts.trained)
    assert kinds["optimizer"] == 2 * 4 * counts.trained + 4 * 4  # and the number of the step for each tensor
    assert kinds["activations"] == 4 * 8 * pixels + 4  # the first layer's output, and the loss
    assert counts.peak >= sum(kinds.values()) >= 4 * (8 + 4) * pixels


def test_fake_tensors_free_what_real_ones_do() -> None:
    live = step_counts.LiveMemory()
    training, scenes = Training(TwoLayers(), "32-true"), synthetic_batch(SIZE, BATCH, 0)
    training.step(scenes)
    training.optimizer.zero_grad()
    with live:
        loss = training.loss(scenes)
        forward = live.peak
    counts = step_counts.count_step(TwoLayers, SIZE, BATCH, 0, "32-true")
    assert live.bytes == counts.memory["activations"]
    del loss
    assert live.bytes == 0
    static = counts.memory["activations"] + counts.memory["intermediate results"]
    assert forward <= static <= 2 * forward


@pytest.mark.parametrize("experiment", ["paper_var_stage2", *SLOW])
def test_a_step_of_the_papers_size_runs_and_takes_no_memory(experiment: str) -> None:
    config = compose_config("plan", f"experiment={experiment}")
    counts = count_work(config, config.data.batch_size)
    assert counts.peak > 15e9
    assert counts.memory["optimizer"] == pytest.approx(2 * 4 * counts.trained, rel=1e-3)  # fused Adam
    assert counts.flops > 6 * 32 * 0.2e9


def on_gpu(config: DictConfig) -> Training:
    with step_counts.WithoutInitialWeights(), torch.device("cuda"):
        return Training(instantiate(config.model, _convert_="all"), "bf16-mixed")


SMALL = ("data.image_size=32", *NETWORKS, "optimizer=adam")  # Muon has thousands of operations
LARGE = [pytest.param((experiment,), marks=pytest.mark.slow) for experiment in PAPER[1:3]]


@pytest.mark.parametrize("settings", [("toy_var", *SMALL), ("toy_diffusion", *SMALL), *LARGE])
@pytest.mark.usefixtures("pretended_gpu")
def test_a_forward_pass_on_a_gpu_finds_all_tensors_there_and_keeps_what_is_counted(settings: tuple[str, ...]) -> None:
    experiment, *sizes = settings
    config = compose_config("plan", f"experiment={experiment}", *sizes)
    copied = without_weights(config)
    copied.rasterizer = {"_target_": "completesplat.training.step_counts.MemoryOnlyRasterizer", "gpu": True}
    batch, live = 4, step_counts.LiveMemory()
    with sdpa_kernel(SDPBackend.MATH):
        expected = count_work(config, batch)
        with step_counts.fake_tensors(), live:
            training = on_gpu(copied)
            scenes = synthetic_batch(config.data.image_size, batch, config.data.targets).to("cuda")
            before = live.bytes
            loss = training.loss(scenes)
            assert loss.device.type == "cuda"
            assert live.bytes - before == pytest.approx(expected.memory["activations"], rel=0.02)
            del loss
            if isinstance(training.module, LatentDiffusion):
                training.module.completesplat.latent_mean = torch.zeros(4, 1, 1, device="cpu")
            else:
                training.module.background = torch.full((3, 1, 1), 0.5)  # a constant that was left on the CPU
            with pytest.raises(RuntimeError, match="two devices, cuda:0 and cpu"):
                training.loss(scenes)
