"""Sequence of kernels over all scenes and views of a batch."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.kernels import array_layout as layout
from completesplat.rasterizers.kernels.composite import STATE_VECTORS, WORD_BITS, composite
from completesplat.rasterizers.kernels.project import prepare, project, project_backward
from completesplat.rasterizers.kernels.runtime import empty, parallel
from completesplat.rasterizers.kernels.simd import LANES

# Views are cut into bands of block rows until there are this many tasks. This is a constant, because sums over bands
# depend on where the bands end, and results must not depend on the number of threads.
FEWEST_TASKS = 4
VIEWS_AT_ONCE = 8  # without gradients, when the projected Gaussians are not kept
CHUNK = 2048  # Gaussians per task of the projection's backward pass


class Parameters(NamedTuple):
    """Contiguous float32 arrays [batch gaussian ...] of a `Gaussians`, or the gradients with respect to them."""

    means: np.ndarray
    quaternions: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray

    def of_scene(self, scene: int) -> "Parameters":
        """Return the arrays [gaussian ...] of one scene."""
        return Parameters(*(array[scene] for array in self))


class RenderedImages(NamedTuple):
    """Arrays [batch view channel height width] of a `Rendering`, or the gradients with respect to them."""

    color: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray

    def view(self, batch: int, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the images of one view in the kernels' shapes: [3 height width], and [height width] twice."""
        return self.color[batch, view], self.depth[batch, view, 0], self.alpha[batch, view, 0]


class BandGradients(NamedTuple):
    """Gradients [batch view band row 16] and places [batch view band lane] of all bands, see `array_layout`."""

    gradients: np.ndarray
    places: np.ndarray


class BatchRendering:
    """Rendering of a batch of scenes in all views, with a backward pass if `keep`.

    Args:
        cameras: [batch view 20], see `array_layout`.
        image_size: height and width in pixels.
        keep: whether `backward` will be called.
    """

    def __init__(
        self, parameters: Parameters, cameras: np.ndarray, image_size: tuple[int, int],
        constants: RenderingConstants, keep: bool,
    ) -> None:  # fmt: skip
        self.parameters = parameters
        self.cameras = cameras
        self.constants = constants
        self.height, self.width = image_size
        self.scenes, self.views = cameras.shape[:2]
        self.count = parameters.means.shape[1]
        # Alphas below 2^-120 count as zero in any case: float32 cannot hold much smaller ones.
        self.log2_min_alpha = math.log2(max(constants.min_alpha, 2.0**-120))
        self.thresholds = (
            np.float32(constants.max_alpha),
            np.float32(self.log2_min_alpha),
            np.float32(constants.min_transmittance),
        )
        self.lanes = -(-self.count // LANES) * LANES
        self.prepared = empty((self.scenes, layout.PREPARED_WIDTH, self.lanes))
        self.held = self.scenes * self.views if keep else min(self.scenes * self.views, VIEWS_AT_ONCE)
        self.records = empty((self.held, self.count, layout.RECORD_WIDTH))
        self.visible_counts = np.zeros(self.held, np.int64)
        rows = -(-self.height // layout.BLOCK)
        count = min(rows, -(-FEWEST_TASKS // max(1, self.scenes * self.views)))
        # First and end block row of each band of a view.
        self.bands = [(i * rows // count, (i + 1) * rows // count) for i in range(count)]

    def render(self) -> RenderedImages:
        """Project and composite every view."""
        images = RenderedImages(self._empty_images(3), self._empty_images(1), self._empty_images(1))
        parallel(self._prepare, self.scenes)
        for start in range(0, self.scenes * self.views, self.held or 1):
            number = min(self.held, self.scenes * self.views - start)
            parallel(partial(self._project, start), number)
            parallel(partial(self._composite, images, start), number * len(self.bands))
        return images

    def backward(self, images: RenderedImages, gradients: RenderedImages) -> Parameters:
        """Return gradients of the parameters from those of the images that `render` returned."""
        bands = len(self.bands)
        views = self.scenes * self.views
        sums = BandGradients(
            empty((self.scenes, self.views, bands, self.count + 1, layout.GRADIENT_WIDTH)),
            empty((self.scenes, self.views, bands, self.lanes), np.int32),
        )
        parallel(partial(self._composite_backward, images, gradients, sums), views * bands)
        result = Parameters(*(empty(array.shape) for array in self.parameters))
        chunks = -(-self.count // CHUNK)
        parallel(partial(self._project_backward, result, sums), self.scenes * chunks)
        return result

    def _empty_images(self, channels: int) -> np.ndarray:
        return np.empty((self.scenes, self.views, channels, self.height, self.width), np.float32)

    def _prepare(self, scene: int) -> None:
        prepare(*self.parameters.of_scene(scene), self.log2_min_alpha, self.prepared[scene])

    def _project(self, start: int, slot: int) -> None:
        scene, camera = divmod(start + slot, self.views)
        room = self.count + 1
        unsorted = empty((room, layout.RECORD_WIDTH))
        keys = empty((2, room), np.int64)
        order = empty((2, room), np.int32)
        self.visible_counts[slot] = project(
            self.prepared[scene], self.cameras[scene, camera], self.height, self.width,
            float(self.constants.blur), float(self.constants.near_plane),
            unsorted, keys, order, self.records[slot],
        )  # fmt: skip

    def _composite(self, images: RenderedImages, start: int, task: int) -> None:
        slot, band = divmod(task, len(self.bands))
        arrays = (*images.view(*divmod(start + slot, self.views)), None, None, None, None, None)
        self._run(slot, band, arrays)

    def _composite_backward(
        self, images: RenderedImages, gradients: RenderedImages, sums: BandGradients, task: int
    ) -> None:
        slot, band = divmod(task, len(self.bands))
        scene, view = divmod(slot, self.views)
        arrays = (
            *images.view(scene, view),
            *gradients.view(scene, view),
            sums.gradients[scene, view, band],
            sums.places[scene, view, band],
        )
        self._run(slot, band, arrays)

    def _run(self, slot: int, band: int, arrays: tuple[np.ndarray | None, ...]) -> None:
        first, end = self.bands[band]
        columns = -(-self.width // layout.BLOCK)
        state = empty(((end - first) * columns * STATE_VECTORS * LANES,))
        open_words = empty((end - first, -(-columns // WORD_BITS)), np.uint64)
        spans = empty((2 * (end - first + LANES),), np.int32)
        count = self.visible_counts[slot]
        composite(self.records[slot], count, first, end, *self.thresholds, state, open_words, spans, *arrays)

    def _project_backward(self, result: Parameters, sums: BandGradients, task: int) -> None:
        scene, chunk = divmod(task, -(-self.count // CHUNK))
        parameters = self.parameters.of_scene(scene)
        project_backward(
            parameters.quaternions,
            parameters.scales,
            parameters.opacities,
            self.prepared[scene],
            self.cameras[scene],
            float(self.constants.blur),
            sums.gradients[scene],
            sums.places[scene],
            chunk * CHUNK,
            min((chunk + 1) * CHUNK, self.count),
            *result.of_scene(scene),
        )
