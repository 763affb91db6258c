"""Base class of modules that turn reference images into Gaussians, with the test that renders, scores and times."""

import statistics
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple, TypeVar, cast

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import gather_values
from completesplat.data.loading.loader import SceneLoader
from completesplat.data.loading.object_data_module import ObjectDataModule
from completesplat.data.sequences import spread_places
from completesplat.evaluation.naive_predictors import (
    Renders,
    copy_reference,
    flat_reference,
    mirror_reference,
    repeat_image,
)
from completesplat.evaluation.records import MODEL
from completesplat.evaluation.regions import REGIONS
from completesplat.evaluation.scene_scores import SceneScores
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.quantities import Share
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch, Views
from completesplat.signals import restore_handlers

Result = TypeVar("Result")

PICTURED_VIEWS = 3


class PicturedScene(NamedTuple):
    """True images of a scene's reference and of some of its novel views, and the first sample's renders of these."""

    truth: Float[Tensor, "view 3 height width"]
    renders: Float[Tensor, "view 3 height width"]


def synchronized_time() -> float:
    """Return the time in seconds, after the GPU, if there is one, has finished its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


class Scorer(LightningModule):
    """Module that turns reference images into Gaussians, with the test that scores their renders.

    Modules that train inherit the test from it.

    Args:
        background: grey value (0 to 1) seen where the Gaussians leave a pixel open.
    """

    upper_bound = False
    """Whether the model has seen the views that it is scored on."""

    fitted_to: str | None = None
    """Views that the Gaussians are fitted to, for tables, or None if scenes are predicted."""

    first_novel = 1
    """Number of views before the novel ones: 1 (the reference that the model is given), or 0 if it is given none."""

    unused_settings: tuple[str, ...] = ()
    """Prefixes of settings that this model does not use, which are refused where a user gives them."""

    draws_samples = False
    """Whether the model draws several samples for one image."""

    def __init__(self, rasterizer: Rasterizer, background: Share = 0.5) -> None:
        super().__init__()
        self.rasterizer = rasterizer
        self.background = background
        self.evaluation = SceneScores()
        self.pictured: dict[str, PicturedScene | None] = {}
        """Pictures of scenes by name; those whose names are set before a test are taken by it."""
        self.seconds: dict[str, list[float]] = defaultdict(list)
        """Seconds by the name of the work: `inference` of a scene with all its samples, `rendering` of one sample."""
        # This is Lightning's name. One of several processes may have no test scene.
        self.allow_zero_length_dataloader_with_multiple_devices = True

    @abstractmethod
    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """Return one set of Gaussians [batch] for each reference image, in its camera's frame.

        A model that draws samples draws one.
        """

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Return `samples` sets for each image and its seed [batch * samples], but one each if nothing is drawn."""
        return self.reconstruct(scenes, seeds[0])

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Return the direction up in the reference camera's frame: as measured on the training set, or the image's."""
        return torch.tensor((0.0, -1.0, 0.0))

    @property
    def data(self) -> SceneDataModule:
        return cast(SceneDataModule, self.trainer.datamodule)  # type: ignore[attr-defined]

    @property
    def method(self) -> str:
        return type(self).__name__

    def render_from(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render several sets of Gaussians [sample], each from the same cameras [view]: [sample view]."""
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, cameras.repeated(len(gaussians.means)))

    def render(self, gaussians: Gaussians, cameras: Cameras) -> Renders:
        """Render scenes [batch] from cameras [batch view], in full precision even if the network runs in less."""
        with torch.autocast(self.device.type, enabled=False):
            return self.rasterizer(gaussians, cameras).over(self.background)

    def on_test_start(self) -> None:
        restore_handlers()  # Lightning's would end a test with exit status 0
        self.evaluation.reset()
        self.evaluation.first_novel = self.first_novel
        self.seconds = defaultdict(list)
        self.mean_image = self.data.mean_image()
        if self.mean_image is None:
            self.evaluation.missing["mean_image"] = "missing: these data have no training images"

    def test_step(self, scenes: SceneBatch, index: int) -> None:
        evaluation = self.evaluation
        names = scenes.names
        # A test at a larger size than the model's has the model's smaller images as well.
        inputs = scenes if scenes.low_resolution is None else scenes.low_resolution
        seeds = [evaluation.scene_seed(name) for name in names]
        gaussians = self.timed("inference", lambda: self.draw(inputs, seeds, evaluation.samples), len(names))
        truth = scenes.all_views()
        cameras = inputs.all_views().cameras
        for b, name in enumerate(names):
            samples = gaussians[b * evaluation.samples : (b + 1) * evaluation.samples]
            self._score_scene(name, samples, cameras[b], truth[b])
        if self.mean_image is not None:
            evaluation.update("mean_image", repeat_image(self.mean_image, scenes), scenes)
        if self.first_novel:
            evaluation.update("copy_reference", copy_reference(scenes), scenes)
            evaluation.update("mirrored_reference", mirror_reference(scenes), scenes)
            if isinstance(self.data, ObjectDataModule):
                evaluation.update("flat_reference", flat_reference(scenes), scenes)

    def _score_scene(self, name: str, samples: Gaussians, cameras: Cameras, truth: Views) -> None:
        """Score the images and the depth of one scene's samples, rendered from cameras [view]."""
        rendered = self.timed("rendering", partial(self.render_from, samples, cameras), len(samples.means))
        images = upsampled(rendered.over(self.background), truth.cameras.image_size)
        self.evaluation.update_samples(name, images, truth)
        if name in self.pictured:
            count = len(truth.images)
            views = [0, *(first + 1 for first in spread_places(count - 1, PICTURED_VIEWS))]
            self.pictured[name] = PicturedScene(truth.images[views].cpu(), images[0, views].cpu())
        if truth.depths is not None:
            if truth.depths.shape[-2:] == rendered.alpha.shape[-2:]:
                self.evaluation.update_depth(name, rendered[0].expected_depth(), truth)
            else:
                reason = "missing: evaluation.resolution is not the size of the renders"
                self.evaluation.missing["depth"] = reason
        self.scene_scored(name, samples, cameras, images, truth)

    def timed(self, name: str, work: Callable[[], Result], count: int) -> Result:
        """Do the work, which is for `count` scenes or samples, and note the seconds for one of them."""
        start = synchronized_time()
        result = work()
        self.seconds[name].append((synchronized_time() - start) / count)
        return result

    def scene_scored(self, name: str, gaussians: Gaussians, cameras: Cameras, images: Renders, truth: Views) -> None:
        """Write the result of a test for a scene: Gaussians [sample], and their images, as they are scored.

        The cameras are those of the renders, which may be smaller than the scored images.
        """

    def on_test_epoch_end(self) -> None:
        """Log every score: the model's as `test/REGION/VIEW/METRIC`, a predictor's as `test/PREDICTOR/REGION/...`.

        Every process gathers the scores of all, so all log the same.
        """
        loader = cast(SceneLoader, self.trainer.test_dataloaders)
        self.evaluation.skipped = {str(error.sequence) for error in loader.refused}
        if loader.refused_depths:
            self.evaluation.missing["depth"] = f"missing: {loader.refused_depths[-1]}"
        self.evaluation.gather()
        # The first duration of each process includes work that is done once.
        seconds_here = {name: values[1:] or values for name, values in self.seconds.items()}
        self.seconds = defaultdict(list)
        for seconds in gather_values(seconds_here):
            for name, values in seconds.items():
                self.seconds[name] += values
        for predictor, scores in self.test_results().items():
            prefix = "test" if predictor == MODEL else f"test/{predictor}"
            for region, view in product(REGIONS, ("novel", "reference")):
                of_view = scores.get(region, {}).get(view, {})
                self.log_dict({f"{prefix}/{region}/{view}/{name}": x for name, x in of_view.items() if x is not None})

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return `SceneScores.results` of the last test, with the medians of the model's `seconds`."""
        results = self.evaluation.results()
        model = results[MODEL]
        model["upper_bound"] = self.upper_bound
        model["fitted_to"] = self.fitted_to
        model["seconds"] = {name: statistics.median(values) for name, values in self.seconds.items()}
        return results

    def predict_step(self, scenes: SceneBatch, index: int) -> Gaussians:
        """Return one set of Gaussians for each reference image, in its camera's frame."""
        return self.reconstruct(scenes, seed=index)


def upsampled(images: Float[Tensor, "batch view 3 _ _"], size: tuple[int, int]) -> Renders:
    """Resize images to the size (height, width) of true images (paper, Table 3: "by upsampling")."""
    if images.shape[-2:] == size:
        return images
    resized = torch.nn.functional.interpolate(images.flatten(0, 1), size, mode="bilinear", align_corners=False)
    return resized.view(*images.shape[:2], *resized.shape[1:])
