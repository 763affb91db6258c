"""`completesplat report depth`: how much samples differ in depth."""

import json
from pathlib import Path
from typing import Any

from completesplat.commands.report import open_run
from completesplat.errors import CompleteSplatError


def depth(config: Any, out: Path) -> None:
    """Write `depth.json` and `depth.png`, and print the table."""
    from rich.console import Console

    from completesplat.reports.sampling.controls import grid
    from completesplat.reports.sampling.depth import rows, strips
    from completesplat.reports.sampling.strips import draw_strips
    from completesplat.reports.tables import table

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
