"""The controls of the page: what completes a photograph, what is shown of the samples, what is saved."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import viser
from diffusers import DDIMScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.generation import CompleteSplat
from completesplat.published import PublishedGenerator

MOST_SAMPLES, MOST_STEPS, MOST_SEED = 8, 100, 99
SLIDERS = ("samples", "skip_weight", "guidance_weight", "steps", "seed")  # settings of `CompleteSplat`
SIDE_BY_SIDE = "all, side by side"
KINDS = {"ply": "PLY", "html": "HTML page", "video": "Video"}


def add_drawing(gui: viser.GuiApi, model: CompleteSplat | PublishedGenerator, start: dict[str, Any]) -> SimpleNamespace:
    """The folders `Photograph` and `Completion`: viser's handles; `start` says where the `SLIDERS` stand at first.

    There are no sliders, nor what belongs to them, for a model that draws no samples.
    """
    blank = np.full((model.image_size, model.image_size, 3), 230, np.uint8)
    with gui.add_folder("Photograph", order=1):
        upload = gui.add_upload_button("Load a picture", mime_type="image/*", hint="completes the scene that it shows")
        preview = gui.add_image(blank, label="none yet", format="png")
    with gui.add_folder("Completion", order=2):
        sliders = add_sliders(gui, model, start) if isinstance(model, CompleteSplat) else {}
        kept, label = "to compare, up to 8 samples", "Draw samples" if sliders else "Reconstruct"
        return SimpleNamespace(
            upload=upload,
            preview=preview,
            **sliders,
            keep=gui.add_checkbox("Keep earlier samples", False, hint=kept),
            draw=gui.add_button(label, color="blue"),
            progress=gui.add_progress_bar(0.0, visible=False),
        )


def add_sliders(gui: viser.GuiApi, model: CompleteSplat, start: dict[str, Any]) -> dict[str, Any]:
    """The `SLIDERS` of a model that draws samples, and whether to draw at once and to show it `forming`."""
    free, diverse = "1: most faithful, 0: most free", "more: more diverse"
    steps, first_steps = possible_steps(model.sampler), nearest_steps(model.sampler, start["steps"])
    return {
        "samples": gui.add_slider("Samples", 1, MOST_SAMPLES, 1, start["samples"]),
        "skip_weight": gui.add_slider("Skip weight", 0.0, 1.0, 0.05, start["skip_weight"], hint=free),
        "guidance_weight": gui.add_slider("Guidance", 0.0, 1.0, 0.05, start["guidance_weight"], hint=diverse),
        "steps": gui.add_slider("Steps", 1, steps[-1], 1, first_steps, hint="denoising steps"),
        "seed": gui.add_slider("Seed", 0, max(MOST_SEED, start["seed"]), 1, start["seed"]),
        "live": gui.add_checkbox("Draw when a slider moves", True),
        "forming": gui.add_checkbox("Show it forming", True, hint="costs a little time at each step"),
    }


def add_looking(gui: viser.GuiApi, layers: int, data_cameras: bool) -> SimpleNamespace:
    """The folder `View`: handles of what is `chosen`, of `layers` by number and of `cameras` by name."""
    names = ["reference", "orbit", *(["data set"] if data_cameras else [])]
    with gui.add_folder("View", order=3):
        return SimpleNamespace(
            chosen=gui.add_dropdown("Show", (SIDE_BY_SIDE,)),
            layers=[gui.add_checkbox(f"Layer {i + 1}", True) for i in range(layers)],
            depth=gui.add_checkbox("Depth as colours", False, hint="near bright, far dark"),
            cameras={name: gui.add_checkbox(f"Cameras: {name}", False) for name in names},
            front=gui.add_button("Look from the front"),
        )


def add_saving(gui: viser.GuiApi) -> dict[str, viser.GuiButtonHandle]:
    """The folder `Save`: buttons by the kind of file."""
    with gui.add_folder("Save", order=4):
        return {kind: gui.add_button(name) for kind, name in KINDS.items()}


def possible_steps(sampler: Sampler) -> list[int]:
    """Numbers of denoising steps up to 100, and the sampler's own one. DDIM's divide the number of noise levels."""
    numbers = range(1, min(MOST_STEPS, sampler.training_timesteps) + 1)
    divides = isinstance(sampler.scheduler, DDIMScheduler)
    found = {n for n in numbers if not (divides and sampler.training_timesteps % n)}
    return sorted(found | {sampler.steps})


def nearest_steps(sampler: Sampler, steps: int) -> int:
    """The possible number of steps that is nearest, the smaller of two."""
    return min(possible_steps(sampler), key=lambda n: abs(n - steps))
