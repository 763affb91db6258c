"""Base class of what turns reference images into Gaussians: it renders them, scores the renders and times the work."""

import hashlib
import statistics
import time
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor
from torch.nn.functional import pad

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import gather_values
from completesplat.data.loading.loader import SceneLoader
from completesplat.errors import CompleteSplatError, PlyError
from completesplat.export.reading import read_gaussians
from completesplat.files import by_numbers, safe_name
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.scoring import MODEL, REGIONS, Evaluation
from completesplat.rasterizers import Rasterizer, Rendering
from completesplat.scene import SceneBatch, Views
from completesplat.settings.schema import Share
from completesplat.signals import restore_handlers
from completesplat.tensors import stack
from completesplat.weights import sha256_of

Result = TypeVar("Result")
Renders = Float[Tensor, "batch view 3 height width"]
FILES = "sample_*.ply"
LEAST_IN_FRONT = 0.1  # of a scene's Gaussians: with less, the axes are wrong
FROM_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def copy_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image for every view. A model that does not beat this and `repeat_image` learned nothing."""
    return scenes.reference.images[:, None].expand_as(scenes.all_views().images)


def mirror_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image, flipped left to right, for every view: often the best naive guess of a back."""
    return copy_reference(scenes).flip(-1)


def repeat_image(image: Float[Tensor, "3 height width"], scenes: SceneBatch) -> Renders:
    """Return an image for every view; the training set's mean image is the best constant prediction of the MSE."""
    return image.to(scenes.reference.images).expand_as(scenes.all_views().images)


def synchronized_time() -> float:
    """Return the time in seconds, after the GPU, if there is one, has finished its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


class Scorer(LightningModule):
    """Base class of what turns reference images into Gaussians, with the test that scores them; it trains nothing.

    Args:
        background: grey value (0 to 1) seen where the Gaussians leave a pixel open.
    """

    upper_bound = False
    """Whether the model has seen the views that it is scored on."""

    fitted_to: str | None = None
    """What Gaussians are fitted to, if scenes are fitted rather than predicted; for tables."""

    first_novel = 1
    """Views of a scene before the novel ones: 1, the reference that the model is given, or 0, if it is given none."""

    without_effect: tuple[str, ...] = ()
    """Beginnings of the names of settings that this model does not use, which are refused where a user gives them."""

    draws_samples = False
    """Whether the model has several answers for one image."""

    def __init__(self, rasterizer: Rasterizer, background: Share = 0.5) -> None:
        super().__init__()
        self.rasterizer = rasterizer
        self.background = background
        self.evaluation = Evaluation()
        self.seconds: dict[str, list[float]] = defaultdict(list)  # for each scene, by the name of the work
        # Lightning's name: some of several processes that test may have no scene.
        self.allow_zero_length_dataloader_with_multiple_devices = True

    @abstractmethod
    def reconstruct(self, scenes: SceneBatch, seed: int) -> Gaussians:
        """Return one set of Gaussians [batch] for each reference image, in its camera's frame."""

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
        seen = scenes if scenes.seen is None else scenes.seen
        seeds = [evaluation.scene_seed(name) for name in names]
        gaussians = self.timed("inference", lambda: self.draw(seen, seeds, evaluation.samples), len(names))
        truth = scenes.all_views()
        cameras = seen.all_views().cameras
        for b, name in enumerate(names):
            samples = gaussians[b * evaluation.samples : (b + 1) * evaluation.samples]
            rendered = self.timed("rendering", partial(self.render_from, samples, cameras[b]), evaluation.samples)
            images = upsampled(rendered.over(self.background), truth.cameras.image_size)
            evaluation.update_samples(name, images, truth[b])
            depths = truth.depths
            if depths is not None and depths.shape[-2:] == rendered.alpha.shape[-2:]:
                evaluation.update_depth(name, rendered[0].expected_depth(), truth[b])
            elif depths is not None:
                evaluation.missing["depth"] = "missing: evaluation.resolution is not the size of the renders"
            self.scene_scored(name, samples, cameras[b], images, truth[b])
        if self.mean_image is not None:
            evaluation.update("mean_image", repeat_image(self.mean_image, scenes), scenes)
        if self.first_novel:
            evaluation.update("copy_reference", copy_reference(scenes), scenes)
            evaluation.update("mirrored_reference", mirror_reference(scenes), scenes)

    def timed(self, name: str, work: Callable[[], Result], scenes: int) -> Result:
        """Do the work for this number of scenes, and note its seconds for each."""
        start = synchronized_time()
        result = work()
        self.seconds[name].append((synchronized_time() - start) / scenes)
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
        local = {name: values[1:] or values for name, values in self.seconds.items()}
        self.seconds = defaultdict(list)
        for name, values in (item for seconds in gather_values(local) for item in seconds.items()):
            self.seconds[name] += values
        for predictor, scores in self.test_results().items():
            prefix = "test" if predictor == MODEL else f"test/{predictor}"
            for region, view in product(REGIONS, ("novel", "reference")):
                values = scores.get(region, {}).get(view, {})
                self.log_dict({f"{prefix}/{region}/{view}/{name}": x for name, x in values.items() if x is not None})

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return `Evaluation.results` of the last test, with the model's seconds for a scene."""
        seconds = {name: statistics.median(values) for name, values in self.seconds.items()}
        results = self.evaluation.results()
        results["model"] |= {"upper_bound": self.upper_bound, "fitted_to": self.fitted_to, "seconds": seconds}
        return results

    def predict_step(self, scenes: SceneBatch, index: int) -> Gaussians:
        """Return one set of Gaussians for each reference image, in its camera's frame."""
        return self.reconstruct(scenes, seed=index)


class SceneFiles(Scorer):
    """Scorer whose samples are the files `sample_*.ply` of each test scene.

    Args:
        folder, frame, align, name: `scenes`, `frame`, `align` and `method` of `conf/test.yaml`.
        **rendering: see `Scorer`.

    Raises:
        CompleteSplatError: there is no such folder.
    """

    draws_samples = True

    def __init__(self, folder: str, frame: str, align: str, name: str | None, **rendering: Any) -> None:
        super().__init__(**rendering)
        self.folder = Path(folder)
        self.frame = frame
        self.align = align
        self.name = name
        self.files: dict[str, list[Path]] = {}
        if not self.folder.is_dir():
            raise CompleteSplatError(f"scenes={folder}: no such folder; give one with SCENE/{FILES}")

    @property
    def method(self) -> str:
        """Return the name of the method, marked as read from files."""
        return f"{self.folder.resolve().name if self.name is None else self.name} (read from files)"

    def find(self, scenes: Sequence[str], samples: int) -> None:
        """Find the first `samples` files of these scenes, by name; raise CompleteSplatError if a scene has fewer."""
        folders = {scene: self.folder / safe_name(scene) for scene in scenes}
        self.files = {scene: sorted(folder.glob(FILES), key=by_numbers)[:samples] for scene, folder in folders.items()}
        if incomplete := [scene for scene, paths in self.files.items() if len(paths) < samples]:
            folder = folders[incomplete[0]]
            count = len(self.files[incomplete[0]])
            present = f"{count} files {FILES}" if folder.is_dir() else "no such folder"
            needed = f"{samples} files are needed ({len(incomplete)} of {len(scenes)} scenes have too few)"
            raise CompleteSplatError(f"{folder}: {present}, {needed}; write them, or score fewer samples")

    def on_test_start(self) -> None:
        self.find(self.data.store("test").names, self.evaluation.samples)  # before any scene is scored
        super().on_test_start()

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        return self.draw(scenes, [seed], 1)

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Read the first files of each scene, and pad the smaller sets with Gaussians of opacity 0."""
        sets = [gaussians for i in range(len(scenes.names)) for gaussians in self._read(scenes[i], samples)]
        most = max(gaussians.count for gaussians in sets)
        return stack([part.map(lambda x: pad(x, (0, 0) * (x.ndim - 1) + (0, most - len(x)))) for part in sets])

    def _read(self, scene: SceneBatch, samples: int) -> list[Gaussians]:
        """Read one scene's samples and place them in the reference camera's frame, in the data's units."""
        sets = []
        paths = self.files[str(scene.names)][:samples]
        for path in paths:
            gaussians = read_gaussians(path)
            if not gaussians.count:
                raise PlyError(f"{path}: holds 0 Gaussians; write it again")
            turned = gaussians.transform(FROM_OPENGL) if self.frame == "opengl" else gaussians
            sets.append(turned.to(scene.reference.images.device))
        if (sets[0].means[:, 2] > 0).float().mean() < LEAST_IN_FRONT:
            other = "opengl" if self.frame == "opencv" else "opencv"
            raise CompleteSplatError(f"{paths[0]}: nearly all Gaussians lie behind the camera; try frame={other}")
        factor = self._scale(sets[0], scene.reference) if self.align == "scale" else 1.0
        if factor is None:
            reason = "at the pixels that its first sample covers"
            if scene.reference.depths is None:
                reason = "(prepared data have none, nor has another evaluation.resolution)"
            raise CompleteSplatError(f"align=scale: {scene.names}: no true depth {reason}; use align=none")
        return [replace(x, means=factor * x.means, scales=factor * x.scales) for x in sets]

    def _scale(self, gaussians: Gaussians, reference: Views) -> float | None:
        """Return the factor that fits rendered depth to true depth best (least squares); None without common pixels."""
        depth = self.render_from(gaussians[None], reference.cameras[None])[0, 0].surface_depth()
        true = torch.zeros_like(depth) if reference.depths is None else reference.depths
        products = (depth * true)[mask := true.isfinite() & (true > 0) & (depth > 0)]
        return (products.sum() / depth[mask].square().sum()).item() if mask.any() else None

    def on_test_epoch_end(self) -> None:
        self.seconds.pop("inference", None)  # this was the time of reading files
        super().on_test_epoch_end()

    def facts(self) -> dict[str, object]:
        """Return facts for the protocol; the checksum covers the sorted lines of `sha256sum` for the used files."""
        paths = [path.relative_to(self.folder) for scene in self.files.values() for path in scene]
        lines = sorted(f"{sha256_of(self.folder / path)}  {path.as_posix()}\n" for path in paths)
        checksum = hashlib.sha256("".join(lines).encode()).hexdigest()
        checkpoint = {"path": str(self.folder), "sha256": checksum, "step": None}
        return {"checkpoint": checkpoint, "ema": None, "frame": self.frame, "align": self.align}


def upsampled(images: Float[Tensor, "batch view 3 _ _"], size: tuple[int, int]) -> Renders:
    """Resize images to the size (height, width) of true images (paper, Table 3: "by upsampling")."""
    if images.shape[-2:] == size:
        return images
    resized = torch.nn.functional.interpolate(images.flatten(0, 1), size, mode="bilinear", align_corners=False)
    return resized.view(*images.shape[:2], *resized.shape[1:])
