"""`completesplat report`: studies of a trained model's samples."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import torch
from rich.console import Console

from completesplat.commands.schema import Filled, Positive, Range
from completesplat.commands.trained import diffusion_of, open_run
from completesplat.errors import CompleteSplatError
from completesplat.results.machine import machine
from completesplat.results.tables import SSIM_NOTE, Column, table
from completesplat.scene import SceneBatch
from completesplat.studies import controls as controls_study
from completesplat.studies import depth as depth_study
from completesplat.studies import masked as masked_study
from completesplat.studies import samplers as samplers_study
from completesplat.studies.figures import draw_strips
from completesplat.studies.samples import SampleRenderer, first_scenes

Several = Annotated[int, Range(2)]
Numbers = Annotated[Sequence[float], Filled()]


def samplers(
    ckpt: str,
    overrides: Sequence[str],
    seed: int,
    scenes: Positive,
    samples: Several,
    samplers: Mapping[str, Mapping[str, Any]],
    steps: Mapping[str, Annotated[Sequence[Annotated[int, Range(1, 1000)]], Filled()]],
    skip_weight: float,
    guidance_weight: float,
    out: Path,
) -> None:
    """Write `samplers.json` and `samplers.png`, print the table and the fewest steps that are enough.

    Args:
        ckpt, overrides: see `open_run`.
        scenes, samples: the first test scenes, and how many samples are drawn of each.
        samplers: configurations by name.
        steps: numbers of steps, by the name of the sampler.

    Raises:
        CompleteSplatError: steps of a sampler that is not there, or impossible ones, or weights outside of [0, 1].
    """
    for name in steps:
        if name not in samplers:
            raise CompleteSplatError(f"steps.{name}: no such sampler; there are {', '.join(samplers)}")
    renderer, found_scenes = _open(ckpt, overrides, scenes, samples, seed)
    weights = {"skip_weight": skip_weight, "guidance_weight": guidance_weight}
    with _status() as tick:
        rows = samplers_study.rows(renderer, samplers, steps, found_scenes, weights, tick)
    best = samplers_study.fewest(rows)
    settings = {"scenes": scenes, "samples": samples, "seed": seed, **weights}
    _write(out / "samplers.json", {"machine": machine(), "settings": settings, "rows": rows, "fewest": dict(best)})
    samplers_study.plot_samplers(rows, out / "samplers.png", f"Samplers: {scenes} scenes, {samples} samples each")
    Console(width=120).print(table(f"Samplers, from the same noise. {SSIM_NOTE}", SAMPLERS, rows))
    name, count = samplers_study.REFERENCE
    print(
        f"fewest denoiser calls within {samplers_study.CLOSE} dB of {name} with {count} steps: {best['calls']} "
        f"({best['sampler']}, {best['steps']} steps, {best['psnr'] - rows[0]['psnr']:+.2f} dB)"
    )


def controls(
    ckpt: str,
    overrides: Sequence[str],
    seed: int,
    scenes: Positive,
    samples: Several,
    skip_weights: Numbers,
    guidance_weights: Numbers,
    near_degrees: float,
    shown: int,
    out: Path,
) -> None:
    """Write `controls.json`, `controls.png` and `controls_grid.png`, and print the table.

    Args:
        ckpt, overrides: see `open_run`.
        scenes, samples: the first test scenes, and how many samples are drawn of each.
        skip_weights, guidance_weights: all their pairs are measured, and the paper's three.
        near_degrees: targets whose optical axes are at most this far from the reference's count as near.
        shown: samples in the grid of renders.

    Raises:
        CompleteSplatError: a weight outside of [0, 1].
    """
    settings = controls_study.grid(skip_weights, guidance_weights)
    renderer, found_scenes = _open(ckpt, overrides, scenes, samples, seed)
    first = found_scenes[0]
    with _status() as tick:
        rows = controls_study.rows(renderer, settings, found_scenes, near_degrees, tick)
        tick("the grid")
        pictures = controls_study.strips(renderer, settings, first, shown)
    described = {"scenes": scenes, "samples": samples, "seed": seed, "near_degrees": near_degrees}
    _write(out / "controls.json", {"settings": described, "rows": rows})
    title = f"Controls: {scenes} scenes, {samples} samples each; (skip, guidance) of the paper in red"
    controls_study.plot_controls(rows, out / "controls.png", title)
    far = f"far view of {min(shown, samples)}"
    title = f"{first.names[0]}: reference view of one sample, {far}; the paper's settings in red"
    draw_strips(*pictures, out / "controls_grid.png", title)
    Console(width=120).print(table("Faithfulness (PSNR, dB) and diversity", CONTROLS, rows))


def masked(
    ckpt: str,
    overrides: Sequence[str],
    seed: int,
    scenes: Positive,
    samples: Several,
    boxes: Sequence[Sequence[float]],
    views: int,
    guidance_weight: float,
    out: Path,
) -> None:
    """Write `masked.png`: inputs with boxes over them, several completions of each.

    Args:
        ckpt, overrides: see `open_run`.
        scenes, samples: the first test scenes, and how many samples are drawn of each.
        boxes: [x0, y0, x1, y1] in shares of the picture; the scenes take turns.
        views: besides the reference view.

    Raises:
        CompleteSplatError: a box without pixels or outside of the picture, or a weight outside of [0, 1].
    """
    for box in boxes:
        masked_study.check_box(box)
    renderer, found_scenes = _open(ckpt, overrides, scenes, samples, seed)
    with _status() as tick:
        tick("completions")
        pictures = masked_study.strips(renderer, found_scenes, boxes, views, guidance_weight)
    draw_strips(*pictures, out / "masked.png", "Completions of partly hidden inputs, without skips")


def depth(
    ckpt: str,
    overrides: Sequence[str],
    seed: int,
    scenes: Positive,
    samples: Several,
    skip_weight: float,
    guidance_weight: float,
    shown_scenes: Positive,
    shown: Positive,
    far_degrees: Annotated[float, Range(0, 180)],
    out: Path,
) -> None:
    """Write `depth.json` and `depth.png`, and print the table.

    Args:
        ckpt, overrides: see `open_run`.
        scenes, samples: the first test scenes, and how many samples are drawn of each.
        skip_weight, guidance_weight: of the figure; measured as well, beside the paper's three settings.
        shown_scenes, shown: scenes and samples in the figure.
        far_degrees: targets whose optical axes are farther than this from the reference's count as far.

    Raises:
        CompleteSplatError: a weight outside of [0, 1].
    """
    settings = controls_study.grid([skip_weight], [guidance_weight])
    renderer, found_scenes = _open(ckpt, overrides, scenes, samples, seed)
    drawn = found_scenes[:shown_scenes]
    with _status() as tick:
        rows = depth_study.rows(renderer, settings, found_scenes, far_degrees, tick)
        tick("the figure")
        pictures = depth_study.strips(renderer, drawn, skip_weight, guidance_weight, shown)
    described = {"scenes": scenes, "samples": samples, "seed": seed, "far_degrees": far_degrees}
    _write(out / "depth.json", {"settings": described, "rows": rows})
    title = f"Render, depth and normals in a far view, and deviation of {samples} samples' depth"
    title += f" in the reference and the far view; skip {skip_weight:g}, guidance {guidance_weight:g}"
    draw_strips(pictures, [scene.names[0] for scene in drawn], out / "depth.png", title)
    Console(width=120).print(table("Deviation of depth over samples, scene units", DEPTH, rows))


def _open(
    ckpt: str, overrides: Sequence[str], scenes: int, samples: int, seed: int
) -> tuple[SampleRenderer, list[SceneBatch]]:
    """Open a run's model for drawing samples, and the first test scenes of the run.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing or does not fit.
        CompleteSplatError: it is no latent diffusion model, or there are too few scenes.
    """
    module, data = open_run(ckpt, overrides)
    model = diffusion_of(module)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    found = [scene.to(device) for scene in first_scenes(data, scenes)]
    return SampleRenderer(model.to(device).eval(), module.rasterizer, module.background, samples, seed), found


def _write(path: Path, results: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    with Console(stderr=True).status("drawing") as status:
        yield lambda text: status.update(f"drawing: {text}")


SAMPLERS: list[Column] = [
    ("sampler", "sampler", ""),
    ("steps", "steps", "d"),
    ("calls", "calls", "d"),
    ("PSNR", "psnr", ".2f"),
    ("SSIM", "ssim", ".4f"),
    ("diversity", "diversity", ".4f"),
    ("agreement", "agreement", ".1f"),
    ("ms", "ms", ".1f"),
]
WEIGHTS: list[Column] = [("skip", "skip_weight", "g"), ("guidance", "guidance_weight", "g")]
CONTROLS: list[Column] = [
    *WEIGHTS,
    ("reference", "reference_psnr", ".2f"),
    ("near object", "near_object_psnr", ".2f"),
    ("diversity", "diversity", ".4f"),
]
DEPTH: list[Column] = [
    *WEIGHTS,
    ("reference", "reference_deviation", ".4f"),
    ("object", "reference_object_deviation", ".4f"),
    ("measured", "reference_measured", ".0%"),
    ("far", "far_deviation", ".4f"),
    ("object", "far_object_deviation", ".4f"),
    ("measured", "far_measured", ".0%"),
]
