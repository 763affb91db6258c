"""`completesplat report`: studies of a trained model's samples.

Each study raises the errors of `trained_model`, `TrainedModel.open`, `diffusion_of`, `first_scenes` and the functions
of its module in `completesplat.evaluation.studies`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NotRequired, Unpack

import torch
from rich.console import Console

from completesplat.commands import quieten
from completesplat.commands.trained import diffusion_of, trained_model
from completesplat.evaluation.studies.calibration import calibration_rows, plot_calibration
from completesplat.evaluation.studies.controls import OnProgress, controls_rows, controls_strips, grid, plot_controls
from completesplat.evaluation.studies.depth import depth_rows, depth_strips
from completesplat.evaluation.studies.ladder import ladder_rows
from completesplat.evaluation.studies.samples import SampleRenderer, first_scenes
from completesplat.evaluation.table_writers import show
from completesplat.evaluation.tables import records_table
from completesplat.export.images import image_sheet, write_png
from completesplat.files import write_json
from completesplat.quantities import Entries, Positive, Range, Share
from completesplat.scene import SceneBatch
from completesplat.settings.schema import ModelSettings
from completesplat.wording import counted

Weights = Annotated[Sequence[Share], Entries(1)]


class Run(ModelSettings):
    """Arguments of `trained_model`, number of test scenes (the first ones), and number of samples of each scene."""

    data: NotRequired[Mapping[str, object]]
    rasterizer: Mapping[str, object]
    scenes: Positive
    samples: Annotated[int, Range(2)]


def controls(
    skip_weights: Weights, guidance_weights: Weights, near_degrees: float, shown: int, out: Path, **run: Unpack[Run]
) -> None:
    """Write `controls.json`, `controls.png` and `controls_grid.png`, and print the table.

    All pairs of the weights and the paper's three are measured; `conf/report_task/controls.yaml` explains the settings.
    """
    weights = grid(skip_weights, guidance_weights)
    with _opened(run) as (renderer, scenes, tick):
        rows = controls_rows(renderer, weights, scenes, near_degrees, tick)
        tick("the grid")
        sheet = controls_strips(renderer, weights, scenes[0], shown)
    title = f"Controls: {counted(len(scenes), 'scene')}, {run['samples']} samples each; the paper's weights in red"
    plot_controls(rows, out / "controls.png", title)
    title = f"{scenes[0].names[0]}: reference view of one sample, far view of {min(shown, run['samples'])}"
    write_png(out / "controls_grid.png", image_sheet(None, sheet, title))
    _report(out / "controls.json", "Faithfulness (PSNR, dB) and diversity", rows, run, near_degrees=near_degrees)


def depth(
    skip_weight: Share,
    guidance_weight: Share,
    shown_scenes: Positive,
    shown: Positive,
    far_degrees: Annotated[float, Range(0, 180)],
    out: Path,
    **run: Unpack[Run],
) -> None:
    """Write `depth.json` and `depth.png`, and print the table. `conf/report_task/depth.yaml` explains the settings."""
    weights = grid([skip_weight], [guidance_weight])
    with _opened(run) as (renderer, scenes, tick):
        rows = depth_rows(renderer, weights, scenes, far_degrees, tick)
        tick("the figure")
        sheet = depth_strips(renderer, scenes[:shown_scenes], skip_weight, guidance_weight, shown)
    title = f"Render, depth and normals in a far view, and deviation of {run['samples']} samples' depth"
    title += f" in the reference and the far view; skip {skip_weight:g}, guidance {guidance_weight:g}"
    write_png(out / "depth.png", image_sheet(None, sheet, title))
    _report(out / "depth.json", "Deviation of depth over samples, scene units", rows, run, far_degrees=far_degrees)


def calibration(skip_weight: Share, guidance_weight: Share, out: Path, **run: Unpack[Run]) -> None:
    """Write `calibration.json` and its figure, and print the table. `Sampling` explains both weights."""
    weights = {"skip_weight": skip_weight, "guidance_weight": guidance_weight}
    with _opened(run) as (renderer, scenes, tick):
        rows = calibration_rows(renderer, scenes, tick, **weights)
    title = f"{counted(run['samples'], 'sample')} of each of {counted(len(scenes), 'scene')}"
    plot_calibration(rows, out / "calibration.png", f"{title}; skip {skip_weight:g}, guidance {guidance_weight:g}")
    ideal = f"calibrated: {1 / (1 + run['samples']):.3g} of the true values below and above all samples, ratio 1"
    _report(out / "calibration.json", f"Novel views; {ideal}", rows, run, **weights)


def ladder(fits: Positive, out: Path, **run: Unpack[Run]) -> None:
    """Write `ladder.json`, and print the table. `ladder_rows` explains its rows."""
    with _opened(run) as (renderer, scenes, tick):
        rows = ladder_rows(renderer, scenes, fits, tick)
    title = f"Where quality is lost: all views and those from behind, PSNR (dB), {counted(len(scenes), 'scene')}"
    _report(out / "ladder.json", title, rows, run, fits=fits)


def _report(path: Path, title: str, rows: Sequence[Mapping[str, object]], run: Run, **settings: float) -> None:
    """Write the rows of a study with its settings to a JSON file, and print them."""
    shared = {"scenes": run["scenes"], "samples": run["samples"], "seed": run["seed"]}
    write_json(path, {"settings": shared | settings, "rows": rows})
    show(records_table(title, rows))


@contextmanager
def _opened(run: Run) -> Iterator[tuple[SampleRenderer, list[SceneBatch], OnProgress]]:
    """Yield renderer and first test scenes (on a GPU if there is one), and a status."""
    quieten()
    settings: Any = {name: value for name, value in run.items() if name not in ("scenes", "samples")}
    stage, data = trained_model(**settings).open()
    stage = stage.to("cuda" if torch.cuda.is_available() else "cpu").eval()
    scenes = [scene.to(stage.device) for scene in first_scenes(data, run["scenes"])]
    renderer = SampleRenderer(diffusion_of(stage), stage.rasterizer, stage.background, run["samples"], run["seed"])
    console = Console(stderr=True)
    with console.status("drawing") as status:  # a log file has a line for each part in its place
        say = status.update if console.is_terminal else console.out
        yield renderer, scenes, lambda text: say(f"drawing: {text}")
