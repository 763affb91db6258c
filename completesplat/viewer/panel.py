"""The controls of the page: what completes a photograph, what is shown of the samples, what is saved."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from diffusers import DDIMScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.generation import CompleteSplat

MOST_SAMPLES, MOST_STEPS, MOST_SEED = 8, 100, 99
SLIDERS = ("samples", "skip_weight", "guidance_weight", "steps", "seed")  # settings of `CompleteSplat`
SIDE_BY_SIDE = "all, side by side"
KINDS = {"ply": "PLY", "html": "HTML page", "video": "Video"}


@dataclass(frozen=True)
class CompletionControls:
    """The photograph, and the settings of its completion."""

    upload: viser.GuiUploadButtonHandle
    preview: viser.GuiImageHandle
    samples: viser.GuiSliderHandle[int]
    skip_weight: viser.GuiSliderHandle[float]
    guidance_weight: viser.GuiSliderHandle[float]
    steps: viser.GuiSliderHandle[int]
    seed: viser.GuiSliderHandle[int]
    live: viser.GuiCheckboxHandle
    forming: viser.GuiCheckboxHandle
    keep: viser.GuiCheckboxHandle
    draw: viser.GuiButtonHandle
    progress: Any

    def settings(self) -> dict[str, Any]:
        """Arguments of `CompleteSplat`."""
        return {name: getattr(self, name).value for name in SLIDERS}


def add_drawing(gui: viser.GuiApi, model: CompleteSplat, start: dict[str, Any]) -> CompletionControls:
    """The folders `Photograph` and `Completion`; `start` says by name where the sliders stand at first."""
    blank = np.full((model.image_size, model.image_size, 3), 230, np.uint8)
    steps, first_steps = possible_steps(model.sampler), nearest_steps(model.sampler, start["steps"])
    with gui.add_folder("Photograph", order=1):
        upload = gui.add_upload_button("Load a picture", mime_type="image/*", hint="completes the scene that it shows")
        preview = gui.add_image(blank, label="none yet", format="png")
    with gui.add_folder("Completion", order=2):
        return CompletionControls(
            upload,
            preview,
            gui.add_slider("Samples", 1, MOST_SAMPLES, 1, start["samples"]),
            gui.add_slider("Skip weight", 0.0, 1.0, 0.05, start["skip_weight"], hint="1: most faithful, 0: most free"),
            gui.add_slider("Guidance", 0.0, 1.0, 0.05, start["guidance_weight"], hint="more: more diverse"),
            gui.add_slider("Steps", 1, steps[-1], 1, first_steps, hint="denoising steps"),
            gui.add_slider("Seed", 0, max(MOST_SEED, start["seed"]), 1, start["seed"]),
            gui.add_checkbox("Draw when a slider moves", True),
            gui.add_checkbox("Show it forming", True, hint="costs a little time at each step"),
            gui.add_checkbox("Keep earlier samples", False, hint="to compare settings, up to 8 samples"),
            gui.add_button("Draw samples", color="blue"),
            gui.add_progress_bar(0.0, visible=False),
        )


@dataclass(frozen=True)
class ViewControls:
    """Which samples, layers and cameras are shown, and in which colours."""

    chosen: viser.GuiDropdownHandle[str]
    layers: list[viser.GuiCheckboxHandle]
    depth: viser.GuiCheckboxHandle
    cameras: dict[str, viser.GuiCheckboxHandle]
    front: viser.GuiButtonHandle


def add_looking(gui: viser.GuiApi, layers: int, data_cameras: bool) -> ViewControls:
    """The folder `View`."""
    names = ["reference", "orbit", *(["data set"] if data_cameras else [])]
    with gui.add_folder("View", order=3):
        return ViewControls(
            gui.add_dropdown("Show", (SIDE_BY_SIDE,)),
            [gui.add_checkbox(f"Layer {i + 1}", True) for i in range(layers)],
            gui.add_checkbox("Depth as colours", False, hint="near bright, far dark"),
            {name: gui.add_checkbox(f"Cameras: {name}", False) for name in names},
            gui.add_button("Look from the front"),
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
