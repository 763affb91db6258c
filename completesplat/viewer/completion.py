"""Completion of photos on the page: the loaded image, its samples, and how they form."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import viser

from completesplat.errors import CompleteSplatError
from completesplat.export.images import to_pixels
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.photo.crop import square_within
from completesplat.photo.photograph import framing_line
from completesplat.photo.reading import Photograph
from completesplat.quantities import Crop
from completesplat.scene_model import SceneModel
from completesplat.viewer.access import show_status
from completesplat.viewer.page import COMPARED, SHOWN, Page
from completesplat.viewer.panel import (
    MOST_SAMPLES,
    SLIDERS,
    SQUARE,
    Pixels,
    add_completion_controls,
    nearest_steps,
    square_of,
    square_on,
    square_text,
)
from completesplat.viewer.photo_file import PhotoFile
from completesplat.viewer.sample import Sample

PAUSE = 0.2  # seconds between two images of a scene that forms
CROPPED = "cropped"  # kind of jobs that no drawing drops, lest a choice is lost while a photo is read


class Completion:
    """Controls that complete a photo, added to a page. The model runs only in the page's worker."""

    def __init__(self, page: Page, model: SceneModel, start: dict[str, Any]) -> None:
        self.page = page
        self.model = model
        self.photo: tuple[PhotoFile, Photograph] | None = None
        self.crop: Crop = "whole"  # of this photo
        self.whole: Pixels | None = None  # all of the photo, once a square was shown on it
        self.controls = add_completion_controls(page.server.gui, model, start)
        page.complete = self.complete
        page.invite()
        self.controls.draw.on_click(lambda event: self.request(event.client))
        self.controls.crop.on_update(self._choose_crop)
        self.controls.form.on_submit(self._take_square)
        for name in SLIDERS:
            getattr(self.controls, name).on_update(self._moved)

    def open(
        self, file: PhotoFile, photograph: Photograph, crop: Crop, client: viser.ClientHandle | None = None
    ) -> None:
        """Show a photo in the panel, and draw its samples.

        Args:
            file: the photo's file.
            photograph: the part of it that `crop` says.
        """
        if self.photo is None or self.photo[0] is not file:
            self.whole = None
        self.photo = file, photograph
        words = [file.name, f"field of view {photograph.fov_degrees:.0f}° ({photograph.fov_source})"]
        framed = framing_line(photograph)
        words += [] if framed is None else [framed]
        self.page.withdraw_invitation()
        self.page.view.fade()
        self.page.set_photo(self._seen(photograph), ", ".join(words))
        self._show_crop(crop)
        self.controls.draw.disabled = False
        self.page.view.set_up(self.model.up.tolist())
        self.request(client)

    def _seen(self, photograph: Photograph) -> Pixels:
        """Return the photo as the model takes it, pale where it is continued, as large as it is compared."""
        size = min(COMPARED, self.model.front_size(photograph, self.controls.detail.value))
        return to_pixels(photograph.shown_at(size))

    def request(self, client: viser.ClientHandle | None = None) -> None:
        """Queue a drawing with the present settings."""
        if self.photo is None:
            return self.page.tell(CompleteSplatError("load an image first"), client)
        file, photograph = self.photo
        settings = {name: getattr(self.controls, name).value for name in SLIDERS}
        self.page.submit(SHOWN, client, partial(self._draw, file.name, photograph, settings))

    def complete(self, image: Path, name: str, client: viser.ClientHandle | None) -> None:
        """Load an image file, or raise CompleteSplatError if it is none or its background cannot be removed."""
        show_status(self.page.server, f"reading {name}")
        crop: Crop = self.controls.crop.value
        if crop == SQUARE:
            crop = "whole"  # because the square is of the photo before
        file = PhotoFile(name, image.read_bytes(), remove_background=self.controls.remove_background.value)
        self.open(file, file.read(self.model, crop), crop, client)

    def _choose_crop(self, event: viser.GuiEvent[Any]) -> None:
        """Take the whole photo or its middle, or show a square on it, which can be dragged."""
        if self.photo is None:
            return
        chosen = self.controls.crop.value
        self.controls.form.visible = chosen == SQUARE
        if chosen == SQUARE and isinstance(self.crop, str):
            self.page.submit("square", event.client, partial(self._show_square, (0.0, 0.0, 1.0)))
        elif chosen not in (SQUARE, self.crop):
            self.page.submit(CROPPED, event.client, partial(self._take, chosen, event.client))

    def _take_square(self, event: viser.GuiEvent[Any]) -> None:
        """Take the square that was typed or dragged."""
        try:
            square = square_of(self.controls.square.value)
        except CompleteSplatError as error:
            return self.page.tell(error, event.client)
        self.page.submit(CROPPED, event.client, partial(self._take, square, event.client))

    def _take(self, crop: Crop, client: viser.ClientHandle | None) -> None:
        """Read the photo's file again, and draw from another part of it."""
        if self.photo is None:
            return
        file, photograph = self.photo
        if not isinstance(crop, str):
            crop = square_within(photograph.photo_size, crop)
        show_status(self.page.server, f"reading {file.name}")
        self.open(file, file.read(self.model, crop), crop, client)

    def _show_crop(self, crop: Crop) -> None:
        """Show in the controls what is taken of the photo."""
        self.crop = crop
        self.controls.form.visible = not isinstance(crop, str)
        if isinstance(crop, str):
            self.controls.crop.value = crop
        else:
            self.controls.crop.value = SQUARE
            self._show_square(crop)

    def _show_square(self, square: Sequence[float]) -> None:
        """Show a square on the whole photo, moved into it, and its numbers."""
        if self.photo is None:
            return
        file, photograph = self.photo
        if self.whole is None:
            self.whole = file.whole(COMPARED)
        within = square_within(photograph.photo_size, square)
        self.controls.picture.content = square_on(self.whole, within)
        self.controls.square.value = square_text(within)

    def _moved(self, event: viser.GuiEvent[Any]) -> None:
        if not isinstance(self.model, CompleteSplat):
            return  # this model draws no samples and has no sliders
        steps = self.controls.steps
        nearest = nearest_steps(self.model.sampler, steps.value)
        if nearest != steps.value:
            steps.value = nearest  # calls this function again
        elif self.controls.live.value and self.photo is not None:
            self.request(event.client)

    def _draw(self, name: str, photograph: Photograph, settings: dict[str, Any]) -> None:
        """Draw samples in the worker's thread, and show them while they form."""
        began = time.monotonic()
        progress = self.controls.progress
        forming = self.controls.forming.value
        before = self.page.view.samples
        up = self.model.up.tolist()
        if self.page.view.up.tolist() != up:  # that of a scene which was opened meanwhile
            self.page.view.set_up(up)
        drawing = Drawing(self, name, photograph, settings)
        show_status(self.page.server, f"drawing from {name}")
        progress.animated = not forming
        progress.visible = True
        progress.value = 0.0 if forming else 100.0
        try:
            scenes = self.model(photograph, on_step=drawing.show_estimate if forming else None, **settings)
            seconds = time.monotonic() - began
            self.page.show(drawing.arranged(scenes, finished=True), f"{len(scenes)} drawn in {seconds:.1f} s")
        except Exception:
            if self.page.view.samples is not before or self.page.view.faded:
                self.page.show(before)
            raise
        finally:
            progress.visible = False


class Drawing:
    """One drawing of samples of a photo, while it is under way."""

    def __init__(self, completion: Completion, name: str, photograph: Photograph, settings: dict[str, Any]) -> None:
        self.page = completion.page
        self.progress = completion.controls.progress
        self.name = name
        self.settings = settings
        model = completion.model
        self.layers = model.parameterization.layers
        self.forming = model.camera(photograph).to("cpu")
        self.reference = model.camera(photograph, model.front_size(photograph, settings["detail"])).to("cpu")
        self.earlier: list[Sample] = []
        if completion.controls.keep.value:
            self.earlier = [sample for sample in self.page.view.samples if sample.finished]
        self.last_shown = 0.0

    def arranged(self, scenes: Sequence[Gaussians], finished: bool) -> list[Sample]:
        """Return the earlier samples and then the new ones, without the first ones if there are too many."""
        reference = self.reference if finished else self.forming
        split = reference.image_size != self.forming.image_size  # so that its Gaussians are not ordered by layer
        layers = 1 if split else self.layers
        new = []
        for i, scene in enumerate(scenes):
            settings = {**self.settings, "image": self.name, "sample": i}
            new.append(Sample(scene.to("cpu"), layers, reference, settings, finished, exact=True))
        return [*self.earlier, *new][-MOST_SAMPLES:]

    def show_estimate(self, step: int, level: int, estimate: Gaussians) -> None:
        """Show the scenes as they are estimated after a denoising step, unless it is too early for another image."""
        if self.page.worker.closed:
            raise SystemExit  # ends this job
        count = self.settings["samples"]
        self.progress.value = min(100.0, 100 * (step + 1) / self.settings["steps"])
        # A model that draws the samples in several batches does not say which of them these are.
        if len(estimate.means) == count and time.monotonic() - self.last_shown > PAUSE:
            self.page.show(self.arranged([estimate[i] for i in range(count)], finished=False), "drawing")
            self.last_shown = time.monotonic()
