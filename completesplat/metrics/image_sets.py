"""Distances between the sets of predicted and true images: FID and KID."""

import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.metrics.images import Images, MissingMetrics, load_or_missing
from completesplat.tensors import as_float64
from completesplat.weights import first_line, weights_file

URL = "https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics/inception-2015-12-05.pt"
SHA256 = "f58cb9b6ec323ed63459aa4fb441fe750cfe39fafad6da5cb504a16f19e958f4"
"""Digest of the file at `URL`, which k-diffusion (`k_diffusion/evaluation.py`) states as well."""
ADVICE = "give inception-2015-12-05.pt as evaluation.scoring.sets.inception.weights=FILE_OR_URL"
DOWNLOAD_ADVICE = f"fetch Inception with `curl -LO {URL}` and give it as evaluation.scoring.sets.inception.weights=FILE"

MetricSettings = Mapping[str, str | int]
Descriptors = Float[Tensor, "image feature"]
FirstSet = Float[Tensor, "first feature"]
SecondSet = Float[Tensor, "second feature"]  # of another number of images


@runtime_checkable
class SetMetric(Protocol):
    """Metric that describes images one by one and then compares the descriptors of two sets."""

    regions: tuple[str, ...]  # the pixels that it measures: "full", "object"

    def describe(self, images: Images) -> Descriptors:
        """Return descriptors of images with values in [0, 1]."""

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """Return figures by name. Lower is better."""

    def settings(self) -> dict[str, MetricSettings]:
        """Return the settings that figures depend on, by the figures' names."""


class ImageSets:
    """Descriptors that set metrics compare, by predictor, region and scene."""

    TRUE = "true"

    def __init__(self, metrics: Sequence[SetMetric]) -> None:
        self.metrics = metrics
        self.described: dict[tuple[str, str, int], dict[str, Descriptors]] = defaultdict(dict)

    def add(self, owner: str, region: str, scene: str, images: Images) -> None:
        """Describe images of a scene, by a predictor or `TRUE`, unless that scene has been described already."""
        for index, metric in enumerate(self.metrics):
            scenes = self.described[owner, region, index]
            if region in metric.regions and scene not in scenes:
                scenes[scene] = metric.describe(images).float().cpu()

    def results(self, owner: str, region: str, missing: dict[str, str]) -> dict[str, float]:
        """Return the distances of a predictor's images from the true images of the same scenes.

        Distances that cannot be computed are left out, and their names added to `missing`, with the reasons.
        """
        figures: dict[str, float] = {}
        for index, metric in enumerate(self.metrics):
            predicted = self.described[owner, region, index]
            true = self.described[self.TRUE, region, index]
            if predicted:
                names = sorted(predicted)
                true_set = torch.cat([true[name] for name in names])
                try:
                    figures |= metric.distances(true_set, torch.cat([predicted[name] for name in names]))
                except Exception as error:  # of any metric; the other scores must not be lost
                    missing |= dict.fromkeys(metric.settings(), f"missing: {first_line(error)}")
        for name, value in figures.items():
            if not math.isfinite(value):
                missing[name] = f"missing: not finite ({value})"
        return {name: value for name, value in figures.items() if math.isfinite(value)}


class Inception:
    """FID and KID (over subsets of at most `subset_size` items), as "fid" and "kid", for all and for object pixels.

    `network` is a TorchScript Inception, which takes 8-bit images, resizes them itself and returns pool features. It is
    called as in NVlabs' `stylegan2-ada-pytorch/metrics`: `network(bytes, return_features=True)`.
    """

    regions = ("full", "object")

    def __init__(self, network: torch.jit.ScriptModule, subset_size: int = 1000) -> None:
        self.network = network.eval()
        self.subset_size = subset_size

    @torch.no_grad()
    def describe(self, images: Images) -> Descriptors:
        """Return features (2048 of NVlabs' network) of sRGB images with values in [0, 1], rounded to 8 bits."""
        pixels = (255 * images.clamp(0, 1)).round().to(torch.uint8)
        with torch.autocast(images.device.type, enabled=False):
            features: Tensor = self.network.to(images.device)(pixels, return_features=True).float()
        return features

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """See `SetMetric`. Raise RuntimeError for a single image, which has no covariance."""
        return {"fid": frechet_distance(true, predicted), "kid": kernel_distance(true, predicted, self.subset_size)}

    def settings(self) -> dict[str, MetricSettings]:
        network = {"network": "inception-2015-12-05", "features": "pool, 2048"}
        return {"fid": network, "kid": network | {"subset_size": self.subset_size, "subsets": 100, "factor": 1}}


def inception(weights: str | None, sha256: str | None = None, subset_size: int = 1000) -> Inception | MissingMetrics:
    """Return FID and KID, or why they are missing. See `load_inception` for the weights."""
    load = partial(load_inception, sha256=sha256, subset_size=subset_size)
    return load_or_missing(weights, load, ADVICE, ("fid", "kid"))


def load_inception(weights: str = URL, sha256: str | None = SHA256, subset_size: int = 1000) -> Inception:
    """Load NVlabs' translation of the network that defines FID (Heusel et al. 2017; `inception-2015-12-05`).

    A TorchScript file is a program. Only one with this SHA-256 (or these first digits) is run; with None, any file.

    Raises:
        WeightsError: the file is missing, cannot be downloaded, is another one, or holds no such network.
    """
    path = weights_file(weights, sha256, DOWNLOAD_ADVICE, "evaluation.scoring.sets.inception.sha256")
    try:
        with warnings.catch_warnings():
            # torch recommends torch.export for new programs; this one is published as TorchScript only.
            warnings.simplefilter("ignore", DeprecationWarning)
            load: Callable[..., Any] = torch.jit.load
            network = load(str(path), map_location="cpu")
    except (OSError, RuntimeError, ValueError) as error:
        raise WeightsError(f"{path}: not a readable TorchScript file; {DOWNLOAD_ADVICE}") from error
    if "return_features" not in {argument.name for argument in network.forward.schema.arguments}:
        raise WeightsError(f"{path}: a TorchScript file, but of a network that gives no features; {DOWNLOAD_ADVICE}")
    return Inception(network, subset_size)


def frechet_distance(first: FirstSet, second: SecondSet) -> float:
    """Return the squared Frechet distance of normal distributions fitted to two sets (Heusel et al. 2017, Eq. 6).

    It is computed in float64 and needs far more items than features. Values for sets of different sizes do not compare.
    """
    from torchmetrics.image.fid import FrechetInceptionDistance

    identity = nn.Identity()
    identity.num_features = first.shape[1]  # type: ignore[assignment]
    # The sets are complete; among several processes torchmetrics would wait for the others' sets and add them.
    first = as_float64(first)
    second = as_float64(second)
    metric = FrechetInceptionDistance(identity, sync_on_compute=False).to(first.device)
    metric.update(first, real=True)
    metric.update(second, real=False)
    return metric.compute().item()


def kernel_distance(
    first: FirstSet, second: SecondSet, subset_size: int = 1000, subsets: int = 100, seed: int = 0
) -> float:
    """Return the squared maximum mean discrepancy, unbiased, so at times below 0 (Binkowski et al. 2018, Section 4).

    The kernel is (x.y / features + 1)^3. The value is a mean over random subsets of at most `subset_size` items, in
    float64, not times 1000. It depends on the order of the items if a set is larger than a subset.
    """
    from torchmetrics.image.kid import poly_mmd

    first = as_float64(first)
    second = as_float64(second)
    size = min(subset_size, len(first), len(second))
    generator = torch.Generator().manual_seed(seed)
    values = []
    for _ in range(subsets):
        some = torch.randperm(len(first), generator=generator)[:size].to(first.device)
        others = torch.randperm(len(second), generator=generator)[:size].to(second.device)
        values.append(poly_mmd(first[some], second[others]))
    return torch.stack(values).mean().item()
