"""`completesplat report`: studies of a trained model's samples.

Each study raises the errors of `Trained.open`, `diffusion_of`, `first_scenes` and the functions of its module in
`completesplat.studies`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypedDict, Unpack

import torch
from rich.console import Console

from completesplat.commands import quieten
from completesplat.commands.protocol import write_json
from completesplat.commands.trained import Trained, diffusion_of
from completesplat.export.images import SheetCell, image_sheet, write_png
from completesplat.results.tables import records_table, show
from completesplat.scene import SceneBatch
from completesplat.settings.schema import Entries, Positive, Range, Share
from completesplat.studies import calibration as calibration_study
from completesplat.studies import controls as controls_study
from completesplat.studies import depth as depth_study
from completesplat.studies.samples import SampleRenderer, first_scenes

Weights = Annotated[Sequence[Share], Entries(1)]


class Run(TypedDict):
    """Model of stage 2 with its data (`Trained`), number of first test scenes, and number of samples of each."""

    ckpt: str | None
    overrides: Sequence[str]
    trust: bool
    weights: str | None
    data: Mapping[str, object] | None
    rasterizer: Mapping[str, object]
    scenes: Positive
    seed: int
    samples: Annotated[int, Range(2)]


def controls(
    skip_weights: Weights,
    guidance_weights: Weights,
    near_degrees: float,
    shown: int,
    out: Path,
    **run: Unpack[Run],
) -> None:
    """Write `controls.json`, `controls.png` and `controls_grid.png`, and print the table.

    All pairs of the weights and the paper's three are measured; `conf/report_task/controls.yaml` explains the settings.
    """
    weights = controls_study.grid(skip_weights, guidance_weights)
    renderer, scenes, settings = _open(run)
    with _status() as tick:
        rows = controls_study.rows(renderer, weights, scenes, near_degrees, tick)
        tick("the grid")
        grid = controls_study.strips(renderer, weights, scenes[0], shown)
    write_json(out / "controls.json", {"settings": settings | {"near_degrees": near_degrees}, "rows": rows})
    title = f"Controls: {len(scenes)} scenes, {run['samples']} samples each; (skip, guidance) of the paper in red"
    controls_study.plot_controls(rows, out / "controls.png", title)
    title = f"{scenes[0].names[0]}: reference view of one sample, far view of {min(shown, run['samples'])}"
    _write_sheet(grid, out / "controls_grid.png", title)
    show(records_table("Faithfulness (PSNR, dB) and diversity", rows))


def depth(
    skip_weight: Share,
    guidance_weight: Share,
    shown_scenes: Positive,
    shown: Positive,
    far_degrees: Annotated[float, Range(0, 180)],
    out: Path,
    **run: Unpack[Run],
) -> None:
    """Write `depth.json` and `depth.png`, and print the table; `conf/report_task/depth.yaml` explains the settings."""
    weights = controls_study.grid([skip_weight], [guidance_weight])
    renderer, scenes, settings = _open(run)
    with _status() as tick:
        rows = depth_study.rows(renderer, weights, scenes, far_degrees, tick)
        tick("the figure")
        sheet = depth_study.strips(renderer, scenes[:shown_scenes], skip_weight, guidance_weight, shown)
    write_json(out / "depth.json", {"settings": settings | {"far_degrees": far_degrees}, "rows": rows})
    title = f"Render, depth and normals in a far view, and deviation of {run['samples']} samples' depth"
    title += f" in the reference and the far view; skip {skip_weight:g}, guidance {guidance_weight:g}"
    _write_sheet(sheet, out / "depth.png", title)
    show(records_table("Deviation of depth over samples, scene units", rows))


def calibration(skip_weight: Share, guidance_weight: Share, out: Path, **run: Unpack[Run]) -> None:
    """Write `calibration.json` and `calibration.png`, and print the tables; the settings are those of `generate`."""
    renderer, scenes, settings = _open(run)
    weights = {"skip_weight": skip_weight, "guidance_weight": guidance_weight}
    with _status() as tick:
        rows = calibration_study.rows(renderer, scenes, tick, **weights)
    write_json(out / "calibration.json", {"settings": settings | weights, "rows": rows})
    title = f"Calibration: {len(scenes)} scenes, {run['samples']} samples each"
    title += f"; skip {skip_weight:g}, guidance {guidance_weight:g}"
    calibration_study.plot_calibration(rows, out / "calibration.png", title)
    ideal = f"calibrated: {1 / (1 + run['samples']):.3g} of the truths below and above all samples, ratio 1"
    energies = [
        {"region": row["region"]} | {f"{count} samples": score for count, score in row["energy_by_samples"].items()}
        for row in rows
    ]
    show(records_table(f"Novel views; {ideal}", rows), records_table("Fair energy score", energies))


def _open(run: Run) -> tuple[SampleRenderer, list[SceneBatch], dict[str, float]]:
    """Return the renderer of a run's samples, its first test scenes, and the settings to write beside the results.

    Renderer and scenes are on a GPU if there is one.
    """
    quieten()
    source = run["ckpt"], run["overrides"], run["trust"], run["weights"], run["data"], run["rasterizer"]
    stage, data = Trained(*source, seed=run["seed"]).open()
    stage.to("cuda" if torch.cuda.is_available() else "cpu").eval()
    scenes = [scene.to(stage.device) for scene in first_scenes(data, run["scenes"])]
    settings: dict[str, float] = {"scenes": run["scenes"], "samples": run["samples"], "seed": run["seed"]}
    model = diffusion_of(stage)
    return SampleRenderer(model, stage.rasterizer, stage.background, run["samples"], run["seed"]), scenes, settings


def _write_sheet(rows: Sequence[Sequence[SheetCell | None]], path: Path, title: str) -> None:
    write_png(path, image_sheet([""] * max(map(len, rows)), rows, title))


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    with Console(stderr=True).status("drawing") as status:
        yield lambda text: status.update(f"drawing: {text}")
