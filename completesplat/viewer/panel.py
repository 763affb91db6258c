"""The controls of the page: what completes a photograph, what is shown of the samples, what is saved."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import viser
from diffusers import DDIMScheduler

from completesplat.diffusion.sampling import Sampler
from completesplat.generation import CompleteSplat
from completesplat.scene_model import SceneModel

MOST_SAMPLES, MOST_STEPS, MOST_SEED = 8, 100, 99
SLIDERS = ("samples", "skip_weight", "guidance_weight", "steps", "seed")  # settings of `CompleteSplat`
SIDE_BY_SIDE = "all, side by side"
ONE_ANSWER = "One answer for each picture: these weights draw no samples."
KINDS = {"ply": "PLY", "html": "HTML page", "video": "Video"}


def add_drawing(gui: viser.GuiApi, model: SceneModel, start: dict[str, Any]) -> SimpleNamespace:
    """The folders `Photograph` and `Completion`: viser's handles; `start` says where the `SLIDERS` stand at first.

    Of a model that draws no samples, what is about drawing is not shown.
    """
    blank = np.full((model.image_size, model.image_size, 3), 230, np.uint8)
    draws, most_steps, first_steps = model.draws_samples, 2, 1
    if isinstance(model, CompleteSplat):
        most_steps, first_steps = possible_steps(model.sampler)[-1], nearest_steps(model.sampler, start["steps"])
    with gui.add_folder("Photograph", order=1):
        upload = gui.add_upload_button("Load a picture", mime_type="image/*", hint="completes the scene that it shows")
        preview = gui.add_image(blank, label="none yet", format="png")
    with gui.add_folder("Completion", order=2):
        if not draws:
            gui.add_markdown(ONE_ANSWER)
        free, diverse = "1: most faithful, 0: most free", "more: more diverse"
        slider: Any = partial(gui.add_slider, visible=draws)
        return SimpleNamespace(
            upload=upload,
            preview=preview,
            samples=slider("Samples", 1, MOST_SAMPLES, 1, start["samples"]),
            skip_weight=slider("Skip weight", 0.0, 1.0, 0.05, start["skip_weight"], hint=free),
            guidance_weight=slider("Guidance", 0.0, 1.0, 0.05, start["guidance_weight"], hint=diverse),
            steps=slider("Steps", 1, most_steps, 1, first_steps, hint="denoising steps"),
            seed=slider("Seed", 0, max(MOST_SEED, start["seed"]), 1, start["seed"]),
            live=gui.add_checkbox("Draw when a slider moves", True, visible=draws),
            forming=gui.add_checkbox("Show it forming", draws, hint="costs a little time at each step", visible=draws),
            keep=gui.add_checkbox("Keep earlier samples", False, hint="to compare settings, up to 8 samples"),
            draw=gui.add_button("Draw samples", color="blue"),
            progress=gui.add_progress_bar(0.0, visible=False),
        )


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
