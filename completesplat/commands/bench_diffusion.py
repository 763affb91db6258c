"""`completesplat bench diffusion`: what stage 2 costs in training and in drawing, one way against another."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from completesplat.errors import CompleteSplatError

# What has to be at least so much, and what has to be one of these.
LEAST = {"repeats": 1, "samples": 1, "steps": 1, "compile_limit": 0}
CHOICES = {"device": ("auto", "cpu", "cuda"), "precision": ("32-true", "bf16-mixed")}


def run(config: Any, out: Path) -> None:
    """Compare on random weights; write `diffusion.json`, print a table."""
    from rich.console import Console

    from completesplat.benchmarks import diffusion
    from completesplat.benchmarks.diffusion import NotMeasured, measured
    from completesplat.results.machine import machine

    device = check_settings(config)
    rows, not_measured = [], {}
    with TemporaryDirectory(prefix="bench_diffusion_", dir=out) as folder:
        comparisons = _comparisons(config, device, Path(folder))
        with Console(stderr=True).status("building") as status:
            for name, compare in comparisons.items():
                status.update(f"timing {name}")
                try:
                    rows.append(measured(compare(), config.repeats, device))
                except NotMeasured as reason:
                    not_measured[name] = str(reason)
    workload = {"device": device.type, "precision": config.precision}
    workload |= {"image_size": config.data.image_size, "batch": config.data.batch_size}
    results = {"machine": machine(), "workload": workload, "rows": rows, "not_measured": not_measured}
    (out / "diffusion.json").write_text(json.dumps(results, indent=2) + "\n")
    diffusion.show(results)


def check_settings(config: Any) -> Any:
    """The device to measure on.

    Raises:
        CompleteSplatError: a setting without a meaning, or a device that is not there.
    """
    import torch

    for name, least in LEAST.items():
        if config[name] < least:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least {least}")
    for name, choices in CHOICES.items():
        if config[name] not in choices:
            raise CompleteSplatError(f"{name}={config[name]}: choose one of {', '.join(choices)}")
    there = torch.cuda.is_available()
    if config.device == "cuda" and not there:
        raise CompleteSplatError("device=cuda: there is no GPU here; device=auto takes what there is")
    return torch.device("cuda" if there and config.device != "cpu" else "cpu")


def _comparisons(config: Any, device: Any, folder: Path) -> dict[str, Callable[[], Any]]:
    """What prepares each comparison when it is its turn."""
    import torch
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    from completesplat.benchmarks import diffusion
    from completesplat.commands import quieten

    quieten()
    data = partial(instantiate, config.data, root=str(folder / "scenes"), _convert_="all")
    data().prepare_data()  # it shows progress of its own
    torch.manual_seed(config.seed)
    module = instantiate(config.model, _convert_="all").to(device)
    batch, precision = config.data.batch_size, config.precision
    few: Any = OmegaConf.to_container(config.few)
    drawn = diffusion.comparisons(module.completesplat, few, config.samples, config.steps, batch)
    optimized = diffusion.Training(module, precision)
    return {
        "cached_vs_on_the_fly": lambda: diffusion.cached_vs_on_the_fly(optimized, data, folder / "latents"),
        **{comparison.name: partial(_same, comparison) for comparison in drawn},
        "compiled_vs_eager": lambda: diffusion.compiled_vs_eager(
            module.completesplat, batch, precision, config.compile_limit
        ),
    }


def _same(comparison: Any) -> Any:
    return comparison
