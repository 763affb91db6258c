"""`completesplat report`: tables, a page, and studies of a trained model's samples."""

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def samplers(config: Any, out: Path) -> None:
    """Write `samplers.json` and `samplers.png`, print the table and the fewest steps that are enough."""
    from omegaconf import OmegaConf
    from rich.console import Console

    from completesplat.autoreconstructor.skips import allowed_skip_weight
    from completesplat.diffusion.guidance import check_guidance_weight
    from completesplat.results.machine import machine
    from completesplat.results.tables import SSIM_NOTE, table
    from completesplat.studies.samplers import CLOSE, REFERENCE, fewest, plot_samplers, rows

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

    from completesplat.results.tables import table
    from completesplat.studies.controls import grid, plot_controls, rows, strips
    from completesplat.studies.samples import draw_strips

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
    from completesplat.studies.masked import strips
    from completesplat.studies.samples import draw_strips

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
    from completesplat.studies.samples import Artist, first_scenes
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


def depth(config: Any, out: Path) -> None:
    """Write `depth.json` and `depth.png`, and print the table."""
    from rich.console import Console

    from completesplat.results.tables import table
    from completesplat.studies.controls import grid
    from completesplat.studies.depth import rows, strips
    from completesplat.studies.samples import draw_strips

    check_settings(config)
    weights = config.skip_weight, config.guidance_weight
    settings = grid(weights[:1], weights[1:])
    artist, scenes = open_run(config)
    with Console(stderr=True).status("drawing") as status:
        found = rows(artist, settings, scenes, config.far_degrees, lambda text: status.update(f"drawing: {text}"))
        status.update("drawing: the figure")
        pictures = strips(artist, scenes[: config.shown_scenes], *weights, config.shown)
    described = {key: config[key] for key in ("scenes", "samples", "seed", "far_degrees")}
    text = json.dumps({"settings": described, "rows": found}, indent=2, allow_nan=False)
    (out / "depth.json").write_text(text + "\n")
    names = [scene.names[0] for scene in scenes[: config.shown_scenes]]
    title = f"Render, depth and normals in a far view, and deviation of {config.samples} samples' depth"
    title += f" in the reference and the far view; skip {weights[0]:g}, guidance {weights[1]:g}"
    draw_strips(pictures, names, out / "depth.png", title)
    columns = [("skip", "skip_weight", "g"), ("guidance", "guidance_weight", "g")]
    for view in ("reference", "far"):
        columns += [(view, f"{view}_deviation", ".4f"), ("object", f"{view}_object_deviation", ".4f")]
        columns += [("measured", f"{view}_measured", ".0%")]
    Console(width=120).print(table("Deviation of depth over samples, scene units", columns, found))


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    if not 0 <= config.far_degrees <= 180:
        raise CompleteSplatError(f"far_degrees={config.far_degrees}: must lie between 0 and 180")
    for name in ("shown", "shown_scenes"):
        if config[name] < 1:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")


logger = logging.getLogger(__name__)
LIMITS = ("frames", "samples", "predictions", "runs", "pictures", "megabytes")


def write(config: Any, out: Path) -> None:
    """Write `report.html` and say how large it is.

    Raises:
        CompleteSplatError: a limit below 1, no such folder, or nothing to show in it.
    """
    limits = {name: config.most[name] for name in LIMITS}
    for name, value in limits.items():
        if value < 1:
            raise CompleteSplatError(f"most.{name}={value}: must be at least 1")

    from completesplat.atomic import atomic_path
    from completesplat.results.html_page import Limits, page
    from completesplat.results.runs import origin

    text, warnings = page(Path(config.runs), out, Limits(**limits), origin(out, levels=0))
    with atomic_path(out / "report.html") as temporary:
        temporary.write_text(text, encoding="utf-8")
    for warning in warnings:
        logger.warning(warning)
    print(f"{out / 'report.html'}: {(out / 'report.html').stat().st_size / 1e6:.1f} MB")


def tables(config: Any, out: Path) -> None:
    """Write `tables.md`, `tables.csv` and `tables.tex`, and print the tables."""
    from completesplat.results.published import tables as made_of
    from completesplat.results.runs import find
    from completesplat.results.tables import show, write_tables

    tree = None if config.runs is None else find(Path(config.runs))
    made = made_of(tree)
    write_tables(made, out)
    show(*made, width=240)
    for warning in tree.warnings if tree else []:
        logger.warning(warning)
