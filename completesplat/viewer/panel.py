"""Controls of the page: completing a photo, viewing its samples, and saving them."""

import base64
import math
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
from completesplat.errors import CompleteSplatError
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
UPLOADS = f"image/*,{','.join(SPLATS)}"
SQUARE = "square"
CROPS = ("whole", "center", SQUARE)
CROP = "what is taken of the photo: all of it, the square in its middle, or a square that you drag on it"
SHARES = "its left and upper edge in shares of width and height, its side in shares of the shorter side; Enter takes it"
FROM_THE_FRONT = "front"
TURN = "turn"
STOP = "stop"
MOTIONS = (FROM_THE_FRONT, TURN, STOP)
TURN_KEY = "T"
STOP_KEY = "X"  # which head.html presses when the scene is touched
KEYS = 9  # keys 1 to 9 choose a sample, 0 shows all
VIDEO = "video"
# Simulates a press of the number's key, which the page hears everywhere, because viser's HTML has no callbacks.
CHOOSE = "this.dispatchEvent(new KeyboardEvent('keydown',{{key:'{0}',code:'Digit{0}',bubbles:true}}))"
UNCOVER = "this.parentNode.style.setProperty('--cut',this.value+'%')"

Pixels = UInt8[np.ndarray, "_ _ 3"]


def add_completion_controls(gui: viser.GuiApi, model: SceneModel, start: dict[str, Any]) -> SimpleNamespace:
    """Add `Draw again` at the top and the folders `Photograph` and `Advanced`, and return viser's handles.

    The controls of drawing are hidden if the model draws no samples.

    Args:
        start: initial values.
    """
    draws = model.draws_samples
    draw = gui.add_button("Draw again", color="blue", icon=viser.Icon.REFRESH, disabled=True, visible=draws, order=0.1)
    progress = gui.add_progress_bar(0.0, visible=False, order=0.11)
    with gui.add_folder("Photograph", order=1):
        if not draws:
            gui.add_markdown("One answer for each image: these weights draw no samples.")
        crop = gui.add_dropdown("Crop", CROPS, initial_value=start["crop"], hint=CROP)
        form = gui.add_form(None, visible=False)
        with form:  # where head.html finds the square's text
            picture = gui.add_html("")
            square = gui.add_text("Square", "", hint=SHARES)
        remove = gui.add_checkbox("Cut the object out", start["remove_background"], hint=CUT_OUT)
        samples = gui.add_slider("Samples", 1, MOST_SAMPLES, 1, start["samples"], visible=draws)
    with gui.add_folder("Advanced", order=5, expand_by_default=False):
        return SimpleNamespace(
            draw=draw,
            progress=progress,
            crop=crop,
            form=form,
            picture=picture,
            square=square,
            remove_background=remove,
            samples=samples,
            **_add_advanced_controls(gui, model, start),
        )


def _add_advanced_controls(gui: viser.GuiApi, model: SceneModel, start: dict[str, Any]) -> dict[str, Any]:
    """Add the sliders that need an explanation, and how drawings begin and show, and return viser's handles."""
    draws = model.draws_samples
    most_steps = 2
    first_steps = 1
    if isinstance(model, CompleteSplat):
        most_steps = possible_steps(model.sampler)[-1]
        first_steps = nearest_steps(model.sampler, start["steps"] or model.sampler.steps)
    slider = cast(Any, partial(gui.add_slider, visible=draws))
    free = "1: most faithful, 0: most free"
    diverse = "more: more diverse"
    fits = start["color_fits"]
    detail = start["detail"]
    seed = start["seed"]
    fast = model.up.device.type != "cpu"
    return {
        "skip_weight": slider("Skip weight", 0.0, 1.0, 0.05, start["skip_weight"], hint=free),
        "guidance_weight": slider("Guidance", 0.0, 1.0, 0.05, start["guidance_weight"], hint=diverse),
        "color_fits": slider("Fits", 0, max(50, fits), 1, fits, hint="rounds of fitting to the image"),
        "detail": slider("Detail", 0, max(1024, detail), 1, detail, hint="pixels of the photo that the front shows"),
        "steps": slider("Steps", 1, most_steps, 1, first_steps, hint="denoising steps"),
        "seed": slider("Seed", 0, max(MOST_SEED, seed), 1, seed),
        "live": gui.add_checkbox("Draw when a slider moves", fast, visible=draws),
        "forming": gui.add_checkbox("Show it forming", draws, hint="costs a little time at each step", visible=draws),
        "keep": gui.add_checkbox("Keep earlier samples", False, hint="to compare settings, up to 8 samples"),
    }


def add_file_controls(gui: viser.GuiApi, scenes: Sequence[str]) -> SimpleNamespace:
    """Add controls that load files, and return handles of `upload` and of `chosen`, which chooses one of the scenes."""
    return SimpleNamespace(
        chosen=gui.add_dropdown("Scene", scenes or [""], visible=len(scenes) > 1, order=0.3),
        upload=gui.add_upload_button("Load a file", mime_type=UPLOADS, hint=FILES, icon=viser.Icon.UPLOAD, order=0.31),
    )


def add_invitation(gui: viser.GuiApi) -> SimpleNamespace:
    """Ask for a photo in the middle of the page, and return handles of the `window` and of its button `upload`."""
    window = gui.add_modal("Drop a photo here")
    with window:
        gui.add_markdown("It becomes a 3D scene that you can turn and save.")
        upload = gui.add_upload_button("Choose a photo", mime_type=UPLOADS, color="blue", icon=viser.Icon.PHOTO)
    return SimpleNamespace(window=window, upload=upload)


def add_view_controls(gui: viser.GuiApi) -> SimpleNamespace:
    """Add buttons that move the camera and the folder `View`, and return their handles.

    They are the `chosen` sample, `layers` by number, `cameras` by name, `photo` and `tiles` above all folders, which
    `comparison` and `tiles` fill, `keys`, commands by digit, `turn` and `stop`, commands, and `motion`, buttons.
    """
    commands = {str(i): f"Show sample {i}" for i in range(1, KEYS + 1)}
    commands["0"] = "Show all samples side by side"
    key: Any = gui.add_command
    photo = gui.add_html("", order=0.4)
    tiles = gui.add_html("", order=0.5)
    motion = gui.add_button_group("Scene", MOTIONS, order=0.6, visible=False)
    folder = gui.add_folder("View", order=3, expand_by_default=False, visible=False)
    with folder:
        return SimpleNamespace(
            photo=photo,
            tiles=tiles,
            motion=motion,
            folder=folder,
            keys={digit: key(label, hotkey=digit) for digit, label in commands.items()},
            turn=key("Turn the scene", hotkey=TURN_KEY),
            stop=key("Stop turning", hotkey=STOP_KEY),
            chosen=gui.add_dropdown("Show", ("sample 1", SIDE_BY_SIDE), hint="keys 1 to 9 choose, 0 shows all"),
            layers=[gui.add_checkbox(f"Layer {i + 1}", True, visible=False) for i in range(MOST_LAYERS)],
            depth=gui.add_checkbox("Depth as colours", False, hint="near bright, far dark"),
            cameras={name: gui.add_checkbox(f"Cameras: {name}", False) for name in ("reference", "orbit")},
        )


def add_save_controls(gui: viser.GuiApi, formats: Sequence[str]) -> SimpleNamespace:
    """Add the button `save` and the file's `kind` (a format or a video), and return their handles."""
    hint = "sog and html need Node.js, usdz completesplat[usd], mesh completesplat[mesh]"
    shown = "what is shown, with all layers"
    save = gui.add_button("Save", hint=shown, icon=viser.Icon.DOWNLOAD, disabled=True, order=0.2)
    return SimpleNamespace(save=save, kind=gui.add_dropdown("Format", (*formats, VIDEO), hint=hint, order=0.21))


def sample_tiles(images: Sequence[Pixels], chosen: int | None) -> str:
    """Return HTML with one button for each sample, which shows it from behind. Those after the ninth do nothing."""
    tiles = []
    for i, image in enumerate(images):
        press = f' onclick="{CHOOSE.format(i + 1)}"' if i < KEYS else " disabled"
        pressed = str(i == chosen).lower()
        picture = f'<img src="{_source(image)}" alt="sample {i + 1}">'
        tiles.append(f'<button type="button" aria-pressed="{pressed}"{press}>{picture}{i + 1}</button>')
    note = "Samples, seen from behind"
    return f'<div class="tiles" role="group" aria-label="{note}">{"".join(tiles)}</div>'


def comparison(photo: Pixels, scene: Pixels | None, label: str) -> str:
    """Return HTML with a line of any text below a photo, and a slider that uncovers the scene on its right.

    Args:
        scene: the scene from the photo's place; None: the photo alone is shown.
    """
    text = f"<p>{escape(label)}</p>"
    below = f'<img src="{_source(photo)}" alt="the photo">'
    if scene is None:
        return f'<div class="comparison"><div>{below}</div>{text}</div>'
    above = f'<img src="{_source(scene)}" alt="the scene from the photo\'s place">'
    slider = f'<input type="range" value="50" aria-label="photo on the left, scene on the right" oninput="{UNCOVER}">'
    ends = "<span>photo</span><span>scene</span>"
    return f'<div class="comparison"><div>{below}{above}</div>{slider}<div class="ends">{ends}</div>{text}</div>'


def square_on(photo: Pixels, square: Sequence[float]) -> str:
    """Return HTML with a square [x, y, size] on a whole photo, on which head.html lets another one be dragged."""
    height, width = photo.shape[:2]
    x, y, share = square
    side = share * min(height, width)
    place = f"left:{x:.2%};top:{y:.2%};width:{side / width:.2%};height:{side / height:.2%}"
    image = f'<img src="{_source(photo)}" alt="the whole photo" draggable="false">'
    note = "Drag a square from corner to corner."
    return f'<div class="crop"><div>{image}<span style="{place}"></span></div><p>{note}</p></div>'


def square_of(text: str) -> tuple[float, float, float]:
    """Return the numbers of a square, typed with or without brackets.

    Raises:
        CompleteSplatError: they are not three finite numbers.
    """
    try:
        x, y, share = (float(word) for word in text.strip(" []").split(","))
        if math.isfinite(x + y + share):
            return x, y, share
    except ValueError:
        pass
    raise CompleteSplatError(f"Square: {text!r} is not x, y, size; give three numbers, such as 0, 0.1, 0.8")


def square_text(square: Sequence[float]) -> str:
    """Return the text of a square, which `square_of` reads."""
    return ", ".join(f"{value:.3g}" for value in square)


def _source(image: Pixels) -> str:
    """Return an image as a data URL, because viser's own images disappear when the panel is moved."""
    content = image_bytes(Image.fromarray(image), "JPEG", quality=90)
    return f"data:image/jpeg;base64,{base64.b64encode(content).decode()}"


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
