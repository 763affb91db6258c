"""`completesplat bench rasterizers`: the backends side by side in one process."""

import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError

logger = logging.getLogger(__name__)


def run(config: Any, out: Path) -> None:
    """Time the rasterizers, or compare them on a scene; write `rasterizers.json` and a plot, print tables."""
    from hydra.utils import instantiate
    from rich.console import Console

    from completesplat.benchmarks import rasterizers
    from completesplat.benchmarks.rasterizers import working_backends
    from completesplat.benchmarks.workloads import read_scene
    from completesplat.results.machine import machine

    check_settings(config)
    constants = instantiate(config.constants)
    measure = partial(_scene, *read_scene(Path(config.scene)), constants) if config.scene else _speed
    with Console(stderr=True).status("compiling") as status:
        backends, absent = working_backends(list(config.backends), constants)
        figures = measure(config, backends, lambda text: status.update(f"timing {text}"))
    results = {"machine": machine(), "not_measured": absent, **figures}
    (out / "rasterizers.json").write_text(json.dumps(results, indent=2) + "\n")
    if results.get("growth"):
        from completesplat.benchmarks import rasterizers

        rasterizers.plot(results["growth"], out / "rasterizers.png")
    rasterizers.show(results)


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    for name in ("sizes", "views", "repeats"):
        values = [config[name]] if name == "repeats" else config[name]
        if isinstance(values, int):
            raise CompleteSplatError(f"{name}={values}: must be a list, {name}=[{values}]")
        if any(value < 1 for value in values):
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")


def _speed(config: Any, backends: list, tick: Callable[[str], None]) -> dict[str, Any]:
    from hydra.utils import instantiate

    from completesplat.benchmarks import rasterizers, training_step
    from completesplat.commands import quieten

    quieten()
    figures = {"rows": rasterizers.speed_rows(backends, list(config.sizes), list(config.views), config.repeats, tick)}
    if config.growth:
        chosen = [backend for backend in backends if backend.name in config.growth.backends]
        figures["growth"] = rasterizers.growth_rows(chosen, tick, config.growth.most_gaussians)
    if config.training_step:
        workload = {key: config.training_step[key] for key in ("size", "batch", "targets", "precision")}
        make_module = partial(instantiate, config.model, _convert_="all")
        figures["training_step"] = []
        for backend in (b for b in backends if b.name in config.training_step.backends):
            tick(f"a training step with {backend.name}")
            row = training_step.share(backend, lambda rasterizer: make_module(rasterizer=rasterizer), **workload)
            figures["training_step"].append(row)
    return figures


def _scene(
    gaussians: Any, cameras: Any, defaults: list[str], constants: Any, config: Any, backends: list,
    tick: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    from completesplat.benchmarks import rasterizers
    from completesplat.benchmarks.workloads import DEFAULTS

    if defaults:
        values = ", ".join(f"{name}={DEFAULTS[name]}" for name in defaults)
        logger.info("%s has no %s: every Gaussian gets %s", config.scene, ", ".join(defaults), values)
    views, (height, width) = cameras.intrinsics.shape[1], cameras.image_size
    tick(f"{gaussians.count} Gaussians in {views} views")
    workload = {"size": max(height, width), "gaussians": gaussians.count, "views": views, "opacity": "file"}
    timed = rasterizers.side_by_side(backends, gaussians, cameras, config.repeats)
    return {
        "rows": [{"backend": name} | workload | figures for name, figures in timed.items()],
        "scene": {"file": str(config.scene), "height": height, "width": width, "defaults": defaults},
        "agreement": rasterizers.agreement_rows(backends, gaussians, cameras, constants, tick),
    }
