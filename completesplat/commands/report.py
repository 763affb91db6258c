"""`completesplat report`: tables of results, and what samplers, controls and masks do to a trained model's samples."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Do the chosen task (`conf/report_task/`)."""
    from hydra.utils import get_method

    get_method(config.task)(config, out)


def samplers(config: Any, out: Path) -> None:
    """Write `samplers.json` and `samplers.png`, print the table and the fewest steps that are enough."""
    from omegaconf import OmegaConf
    from rich.console import Console

    from completesplat.autoreconstructor.skips import allowed_skip_weight
    from completesplat.diffusion.guidance import check_guidance_weight
    from completesplat.reports.machine import machine
    from completesplat.reports.sampling.samplers import CLOSE, REFERENCE, fewest, rows
    from completesplat.reports.sampling.samplers_plot import plot_samplers
    from completesplat.reports.sweeps.headline import SSIM_NOTE
    from completesplat.reports.tables import table

    configs: Any = OmegaConf.to_container(config.samplers)
    for name, counts in config.steps.items():
        if name not in configs:
            raise CompleteSplatError(f"steps.{name}: no such sampler; there are {', '.join(configs)}")
        _all_between(f"steps.{name}", counts, 1, 1000)
    allowed_skip_weight(config.skip_weight)
    check_guidance_weight(config.guidance_weight)
    artist, scenes = open_run(config)
    weights = {"skip_weight": config.skip_weight, "guidance_weight": config.guidance_weight}
    with _status() as tick:
        found = rows(artist, configs, config.steps, scenes, weights, tick)
    best = fewest(found)
    settings = {"scenes": len(scenes), "samples": config.samples, "seed": config.seed, **weights}
    _write(out / "samplers.json", {"machine": machine(), "settings": settings, "rows": found, "fewest": dict(best)})
    plot_samplers(found, out / "samplers.png", f"Samplers: {len(scenes)} scenes, {config.samples} samples each")
    columns = [("sampler", "sampler", ""), ("steps", "steps", "d"), ("calls", "calls", "d"), ("PSNR", "psnr", ".2f")]
    columns += [("SSIM", "ssim", ".4f"), ("diversity", "diversity", ".4f"), ("agreement", "agreement", ".1f")]
    Console(width=120).print(
        table(f"Samplers, from the same noise. {SSIM_NOTE}", [*columns, ("ms", "ms", ".1f")], found)
    )
    name, count = REFERENCE
    print(
        f"fewest denoiser calls within {CLOSE} dB of {name} with {count} steps: {best['calls']} "
        f"({best['sampler']}, {best['steps']} steps, {best['psnr'] - found[0]['psnr']:+.2f} dB)"
    )


def controls(config: Any, out: Path) -> None:
    """Write `controls.json`, `controls.png` and `controls_grid.png`, and print the table."""
    from rich.console import Console

    from completesplat.reports.sampling.controls import grid, rows, strips
    from completesplat.reports.sampling.controls_plot import plot_controls
    from completesplat.reports.sampling.strips import draw_strips
    from completesplat.reports.tables import table

    for name in ("skip_weights", "guidance_weights"):
        _require_list(name, config[name])
    settings = grid(config.skip_weights, config.guidance_weights)
    artist, scenes = open_run(config)
    with _status() as tick:
        found = rows(artist, settings, scenes, config.near_degrees, tick)
        tick("the grid")
        pictures = strips(artist, settings, scenes[0], config.shown)
    described = {key: config[key] for key in ("scenes", "samples", "seed", "near_degrees")}
    _write(out / "controls.json", {"settings": described, "rows": found})
    title = f"Controls: {len(scenes)} scenes, {config.samples} samples each; (skip, guidance) of the paper in red"
    plot_controls(found, out / "controls.png", title)
    shown = min(config.shown, config.samples)
    labels = f"{scenes[0].names[0]}: reference view of one sample, far view of {shown}; the paper's settings in red"
    draw_strips(*pictures, out / "controls_grid.png", labels)
    columns = [
        ("skip", "skip_weight", "g"),
        ("guidance", "guidance_weight", "g"),
        ("reference", "reference_psnr", ".2f"),
    ]
    columns += [("near object", "near_object_psnr", ".2f"), ("diversity", "diversity", ".4f")]
    Console(width=120).print(table("Faithfulness (PSNR, dB) and diversity", columns, found))


def masked(config: Any, out: Path) -> None:
    """Write `masked.png`: inputs with boxes over them, several completions of each."""
    from completesplat.diffusion.guidance import check_guidance_weight
    from completesplat.reports.sampling.masked import strips
    from completesplat.reports.sampling.strips import draw_strips

    for box in config.boxes:
        if len(box) != 4 or not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
            raise CompleteSplatError(f"boxes: {list(box)} is no [x0,y0,x1,y1] with 0 <= x0 < x1 <= 1 and so on")
    check_guidance_weight(config.guidance_weight)
    artist, scenes = open_run(config)
    with _status() as tick:
        tick("completions")
        rows = strips(artist, scenes, [list(box) for box in config.boxes], config.views, config.guidance_weight)
    draw_strips(*rows, out / "masked.png", "Completions of partly hidden inputs, without skips")


def open_run(config: Any) -> tuple[Any, list[Any]]:
    """The generator of a checkpoint, ready to draw, and the first test scenes of its run.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing or does not fit.
        CompleteSplatError: it is no latent diffusion model, or there are too few scenes or samples.
    """
    import torch
    from hydra.utils import instantiate

    from completesplat.commands import quieten
    from completesplat.commands.trained import config_of_run, diffusion_of
    from completesplat.reports.sampling.drawing import Artist, first_scenes
    from completesplat.training.checkpoints import load_part

    for name, least in (("scenes", 1), ("samples", 2)):
        if config[name] < least:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least {least}")
    run_config = config_of_run(Path(config.ckpt), list(config.overrides))
    quieten()
    module = instantiate(run_config.model, _convert_="all")
    model = diffusion_of(module)
    load_part(module, config.ckpt, prefix="")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    data = instantiate(run_config.data, _convert_="all")
    scenes = [scene.to(device) for scene in first_scenes(data, config.scenes)]
    artist = Artist(model.to(device).eval(), module.rasterizer, module.background, config.samples, config.seed)
    return artist, scenes


def _all_between(name: str, values: Any, least: float, most: float) -> None:
    _require_list(name, values)
    if any(not least <= value <= most for value in values):
        raise CompleteSplatError(f"{name}={values}: all must lie between {least:g} and {most:g}")


def _require_list(name: str, values: Any) -> None:
    if isinstance(values, int | float | str) or not values:
        raise CompleteSplatError(f"{name}={values}: must be a list of numbers")


def _write(path: Path, results: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    from rich.console import Console

    with Console(stderr=True).status("drawing") as status:
        yield lambda text: status.update(f"drawing: {text}")
