"""`completesplat bench paper`: the durations that the paper gives, beside ours."""

import json
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from completesplat.errors import CompleteSplatError

OF_THE_PAPER = {
    "data.image_size": 128,
    "data.batch_size": 32,
    "samples": 20,
    "sampler.steps": 50,
    "autoreconstructor.encoder.channels": [128, 256, 512, 512],
    "denoiser.channels": [320, 640, 1280, 1280],
}


def run(config: Any, out: Path) -> None:
    """Measure on random weights; write `paper.json`, print a table."""
    from rich.console import Console

    from completesplat.benchmarks import paper
    from completesplat.benchmarks.paper import FIGURES
    from completesplat.results.machine import machine

    device = _device(config)
    with (
        TemporaryDirectory(prefix="bench_paper_", dir=out) as folder,
        Console(stderr=True).status("building") as status,
    ):
        found = _rows(config, device, Path(folder), lambda text: status.update(f"timing {text}"))
    workload = {"device": device.type, "image_size": config.data.image_size, "batch": config.data.batch_size}
    workload |= {"samples": config.samples, "steps": config.sampler.steps, "repeats": config.repeats}
    if is_as_in_the_paper(config):
        found = [FIGURES[row["name"]].durations() | row for row in found]
    results = {"machine": machine(), "workload": workload, "rows": found}
    (out / "paper.json").write_text(json.dumps(results, indent=2) + "\n")
    paper.show(results)


def is_as_in_the_paper(config: Any) -> bool:
    """Whether the work is that which the paper's durations are of, so that they can stand beside ours."""
    from omegaconf import OmegaConf

    return all(OmegaConf.select(config, key) == value for key, value in OF_THE_PAPER.items())


def _device(config: Any) -> Any:
    """The device to measure on.

    Raises:
        CompleteSplatError: a setting without a meaning, or no GPU.
    """
    import torch

    for name in ("repeats", "samples"):
        if config[name] < 1:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")
    if config.device not in ("cpu", "cuda"):
        raise CompleteSplatError(f"device={config.device}: choose one of cuda, cpu")
    if config.device == "cuda" and not torch.cuda.is_available():
        raise CompleteSplatError(
            "the paper's figures are a GPU's, and there is none here: device=cpu measures all the same, "
            "autoreconstructor=tiny conditioning=learned denoiser=tiny in minutes"
        )
    return torch.device(config.device)


def _rows(config: Any, device: Any, folder: Path, tick: Any) -> list[dict[str, Any]]:
    """The stages one after the other, so that the memory of one is not counted for the other."""
    import torch
    from hydra.utils import instantiate

    from completesplat.benchmarks import paper
    from completesplat.benchmarks.paper import WAYS, compiled
    from completesplat.commands import quieten

    quieten()
    data = instantiate(config.data, root=str(folder / "scenes"), _convert_="all")
    data.prepare_data()
    scenes = next(iter(data.train_dataloader())).to(device)
    ways = [way for way in WAYS if config.compile or way.compile is None]
    found = []
    for name, work in ("stage1", paper.stage1), ("stage2", partial(paper.stage2, samples=config.samples)):
        torch.manual_seed(config.seed)
        module = instantiate(config[name], _convert_="all").to(device)
        for way in ways:
            with compiled(paper.networks(module), way):
                pieces = work(module, scenes, precision=way.precision)
                if not config.training or way.graphs:  # graphs and optimizer steps do not go together
                    del pieces[f"{name}_step"]
                found += paper.rows(way, pieces, config.repeats, device, tick)
    return found
