"""Training by two processes, which talk through gloo, against one: figures, weights, and what is left is rounding."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from hydra.utils import instantiate
from small_runs import rows
from support import SMALL, compose_config
from torch import multiprocessing

from completesplat.training.loggers import ContinuedCSVLogger

pytestmark = pytest.mark.processes
# Without anything that is drawn in the steps: what processes draw is their own.
SETTINGS = ["experiment=toy_var", "ablation=no_variational", "autoreconstructor.skip_dropout=0", *SMALL]
SETTINGS += ["rasterizer=reference", "data.image_size=16", "data.batch_size=4", "data.references_per_sequence=8"]
SETTINGS += ["optimizer=adam", "optimizer._target_=torch.optim.SGD", "optimizer.fused=false", "optimizer.lr=0.1"]
SETTINGS += ["trainer.precision=32-true", "trainer.log_every_n_steps=1", "trainer.val_check_interval=2"]


class Trained(NamedTuple):
    """Weights, the rows of `metrics.csv`, and what was logged in the end."""

    weights: dict[str, torch.Tensor]
    rows: list[dict[str, str]]
    metrics: dict[str, float]


def train(root: Path, folder: Path, devices: int, *settings: str, dtype: torch.dtype = torch.float32) -> Trained:
    """Train in a spawned process, because forks of this one could crash: threads of other tests may have run in it."""
    folder.mkdir()
    multiprocessing.spawn(train_here, (root, folder, devices, settings, dtype))
    weights, metrics = torch.load(folder / "trained.pt", weights_only=True)
    return Trained(weights, rows(folder), metrics)


def train_here(_: int, root: Path, folder: Path, devices: int, settings: tuple[str, ...], dtype: torch.dtype) -> None:
    torch.set_num_threads(1)
    torch.set_default_dtype(dtype)
    config = compose_config("fit", f"data.root={root}", *SETTINGS, *settings, f"out={folder}")
    torch.manual_seed(0)
    data, module = (instantiate(part, _convert_="all") for part in (config.data, config.model))
    several = {"devices": devices, "strategy": "ddp_fork" if devices > 1 else "auto"}
    several |= {"enable_checkpointing": False, "plugins": []}
    logger = ContinuedCSVLogger(str(folder))
    trainer: Any = instantiate(config.trainer, **several, enable_progress_bar=False, logger=logger, _convert_="all")
    if dtype == torch.float64:  # Lightning's own precision=64-true cannot convert frozen classes
        torch.Tensor.float = torch.Tensor.double  # type: ignore[assignment]  # which networks call to widen bfloat16
        module.double()
        module.on_after_batch_transfer = lambda scenes, _: scenes.map(widened)
    trainer.fit(module, datamodule=data)
    metrics = {name: value.item() for name, value in trainer.callback_metrics.items()}
    torch.save((module.state_dict(), metrics), folder / "trained.pt")


def widened(values: torch.Tensor) -> torch.Tensor:
    return values.double() if values.is_floating_point() else values


def furthest(one: Trained, other: Trained) -> float:
    return max((one.weights[name] - value).abs().max().item() for name, value in other.weights.items())


def test_the_figures_of_two_processes_are_those_of_one(toy_root, tmp_path):
    one, two = (train(toy_root, tmp_path / str(n), n, "trainer.max_steps=2") for n in (1, 2))
    assert len(one.rows) == len(two.rows) > 2
    for alone, shared in zip(one.rows, two.rows, strict=True):
        assert alone.keys() == shared.keys()
        for name, value in alone.items():
            assert (value == "") == (shared[name] == "")
            assert value == "" or math.isclose(float(value), float(shared[name]), rel_tol=1e-5, abs_tol=1e-6), name
    assert two.metrics == pytest.approx(one.metrics, rel=1e-5)


@pytest.mark.slow
def test_the_weights_of_two_processes_are_those_of_one_up_to_rounding(toy_root, tmp_path):
    """In float64, of 2**29 times the resolution, they differ by so much less: by rounding alone."""
    apart = {}
    given = ["trainer.max_steps=32", "trainer.val_check_interval=32", "trainer.limit_val_batches=0"]
    for dtype in (torch.float32, torch.float64):
        one, two = (train(toy_root, tmp_path / f"{dtype}-{n}", n, *given, dtype=dtype) for n in (1, 2))
        apart[dtype] = furthest(one, two)
    assert apart[torch.float64] < 1e-9
    assert 0 < apart[torch.float32] < 1e-3
    assert apart[torch.float64] < apart[torch.float32] * 2**-20
