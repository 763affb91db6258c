"""Controls of the page: completing a photo, viewing its samples, and saving them."""

import base64
from collections.abc import Sequence
from functools import partial
from html import escape
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import viser
from diffusers import DDIMScheduler
from jaxtyping import UInt8
from PIL import Image

from completesplat.diffusion.sampling import Sampler
from completesplat.generator import CompleteSplat
from completesplat.photo.saving import image_bytes
from completesplat.quantities import SPLATS
from completesplat.scene_model import SceneModel
from completesplat.viewer.sample import MOST_LAYERS

MOST_SAMPLES = 8
MOST_STEPS = 100
MOST_SEED = 99
SLIDERS = (
    "samples",
    "skip_weight",
    "guidance_weight",
    "color_fits",
    "detail",
    "steps",
    "seed",
)  # settings of `CompleteSplat`
SIDE_BY_SIDE = "all, side by side"
CUT_OUT = (
    "of the next images: only the object, on the weights' background (needs completesplat[background] or [grabcut])"
)
FILES = f"an image to complete, or a scene ({', '.join(SPLATS)}); or drop the file anywhere on the page"
KEYS = 9  # keys 1 to 9 choose a sample, 0 shows all
VIDEO = "video"
# Simulates a press of the number's key, which the page hears everywhere, because viser's HTML has no callbacks.
CHOOSE = "this.dispatchEvent(new KeyboardEvent('keydown',{{key:'{0}',code:'Digit{0}',bubbles:true}}))"

Pixels = UInt8[np.ndarray, "_ _ 3"]


def add_completion_controls(gui: viser.GuiApi, model: SceneModel, start: dict[str, Any]) -> SimpleNamespace:
    """Add the folders `Photograph` and `Completion`, and return viser's handles.

    The controls of drawing are hidden if the model draws no samples.

    Args:
        start: initial values.
    """
    draws = model.draws_samples
    most_steps = 2
    first_steps = 1
    if isinstance(model, CompleteSplat):
        most_steps = possible_steps(model.sampler)[-1]
        first_steps = nearest_steps(model.sampler, start["steps"] or model.sampler.steps)
    with gui.add_folder("Photograph", order=1):
        preview = gui.add_html("")
        remove = gui.add_checkbox("Cut the object out", start["remove_background"], hint=CUT_OUT)
    with gui.add_folder("Completion", order=2):
        if not draws:
            gui.add_markdown("One answer for each image: these weights draw no samples.")
        free = "1: most faithful, 0: most free"
        diverse = "more: more diverse"
        slider = cast(Any, partial(gui.add_slider, visible=draws))
        fits = start["color_fits"]
        detail = start["detail"]
        return SimpleNamespace(
            preview=preview,
            remove_background=remove,
            samples=slider("Samples", 1, MOST_SAMPLES, 1, start["samples"]),
            skip_weight=slider("Skip weight", 0.0, 1.0, 0.05, start["skip_weight"], hint=free),
            guidance_weight=slider("Guidance", 0.0, 1.0, 0.05, start["guidance_weight"], hint=diverse),
            color_fits=slider("Fits", 0, max(50, fits), 1, fits, hint="rounds of fitting to the image"),
            detail=slider("Detail", 0, max(1024, detail), 1, detail, hint="pixels of the photo that the front shows"),
            steps=slider("Steps", 1, most_steps, 1, first_steps, hint="denoising steps"),
            seed=slider("Seed", 0, max(MOST_SEED, start["seed"]), 1, start["seed"]),
            live=gui.add_checkbox("Draw when a slider moves", True, visible=draws),
            forming=gui.add_checkbox("Show it forming", draws, hint="costs a little time at each step", visible=draws),
            keep=gui.add_checkbox("Keep earlier samples", False, hint="to compare settings, up to 8 samples"),
            draw=gui.add_button("Draw samples", color="blue"),
            progress=gui.add_progress_bar(0.0, visible=False),
        )


def add_file_controls(gui: viser.GuiApi, scenes: Sequence[str]) -> SimpleNamespace:
    """Add controls that load files, and return handles of `upload` and of `chosen`, which chooses one of the scenes."""
    return SimpleNamespace(
        chosen=gui.add_dropdown("Scene", scenes or [""], visible=len(scenes) > 1, order=0.2),
        upload=gui.add_upload_button("Load a file", mime_type=f"image/*,{','.join(SPLATS)}", hint=FILES, order=0.3),
    )


def add_view_controls(gui: viser.GuiApi) -> SimpleNamespace:
    """Add the folder `View`, and return its handles.

    They are the `chosen` sample, `layers` by number, `cameras` by name, `thumbnails` above all folders, which
    `thumbnail_row` fills, and `keys`, commands by digit.
    """
    commands = {str(i): f"Show sample {i}" for i in range(1, KEYS + 1)}
    commands["0"] = "Show all samples side by side"
    key: Any = gui.add_command
    thumbnails = gui.add_html("", order=0.5)
    with gui.add_folder("View", order=3):
        return SimpleNamespace(
            thumbnails=thumbnails,
            keys={digit: key(label, hotkey=digit) for digit, label in commands.items()},
            chosen=gui.add_dropdown("Show", ("sample 1", SIDE_BY_SIDE), hint="keys 1 to 9 choose, 0 shows all"),
            layers=[gui.add_checkbox(f"Layer {i + 1}", True, visible=False) for i in range(MOST_LAYERS)],
            depth=gui.add_checkbox("Depth as colours", False, hint="near bright, far dark"),
            cameras={name: gui.add_checkbox(f"Cameras: {name}", False) for name in ("reference", "orbit")},
            front=gui.add_button("Look from the front"),
        )


def add_save_controls(gui: viser.GuiApi, formats: Sequence[str]) -> SimpleNamespace:
    """Add the folder `Save`, and return handles of the file's `kind` (a format or a video) and of the button `save`."""
    with gui.add_folder("Save", order=4):
        kind = gui.add_dropdown(
            "Format",
            (*formats, VIDEO),
            hint="sog and html need Node.js, usdz completesplat[usd], mesh completesplat[mesh]",
        )
        return SimpleNamespace(kind=kind, save=gui.add_button("Save", hint="what is shown, with all layers"))


def thumbnail_row(images: Sequence[Pixels], chosen: int | None) -> str:
    """Return HTML with numbered images of samples. A click on one of the first nine chooses it."""
    cells = []
    for i, image in enumerate(images):
        line = "#228be6" if i == chosen else "transparent"
        press = f' onclick="{CHOOSE.format(i + 1)}"' if i < KEYS else ""
        style = f"width:100%;display:block;border:2px solid {line};cursor:pointer"
        cells.append(f'<div><img src="{_source(image)}" alt="sample {i + 1}" style="{style}"{press}>{i + 1}</div>')
    style = (
        "display:grid;grid-template-columns:repeat(4,1fr);gap:4px;padding:0 12px 8px;font-size:12px;text-align:center"
    )
    return f'<div style="{style}">{"".join(cells)}</div>'


def preview_of(image: Pixels, label: str) -> str:
    """Return HTML with a line of any text above the image that is completed."""
    style = "padding:0 8px 8px;font-size:14px"
    return f'<div style="{style}">{escape(label)}<img src="{_source(image)}" alt="" style="display:block"></div>'


def _source(image: Pixels) -> str:
    """Return an image as a data URL, because viser's own images disappear when the panel is moved."""
    content = image_bytes(Image.fromarray(image), "PNG")
    return f"data:image/png;base64,{base64.b64encode(content).decode()}"


def possible_steps(sampler: Sampler) -> list[int]:
    """Return the sampler's default steps and all others up to 100. Those of DDIM divide the number of noise levels."""
    levels = sampler.training_timesteps
    steps = set(range(1, min(MOST_STEPS, levels) + 1))
    if isinstance(sampler.scheduler, DDIMScheduler):
        steps = {count for count in steps if levels % count == 0}
    return sorted(steps | {sampler.steps})


def nearest_steps(sampler: Sampler, steps: int) -> int:
    """Return the possible number of steps nearest to `steps`, the smaller one of two."""
    return min(possible_steps(sampler), key=lambda n: abs(n - steps))
