"""Distances between the sets of predicted and true images: FID, KID, sliced Wasserstein."""

import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from completesplat.errors import WeightsError
from completesplat.metrics.images import Images, Missing, unless_missing
from completesplat.weights import weights_file

URL = "https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics/inception-2015-12-05.pt"
SHA256 = "f58cb9b6ec323ed63459aa4fb441fe750cfe39fafad6da5cb504a16f19e958f4"
"""Digest of the file at `URL`; k-diffusion (`k_diffusion/evaluation.py`) states the same."""
ADVICE = "give inception-2015-12-05.pt as evaluation.scoring.sets.inception.weights=FILE_OR_URL"
DOWNLOAD_ADVICE = f"fetch Inception with `curl -LO {URL}` and give it as evaluation.scoring.sets.inception.weights=FILE"

Settings = Mapping[str, str | int]
Descriptors = list[Tensor]  # of several images; one tensor [images * n features] for each kind of descriptor


@runtime_checkable
class SetMetric(Protocol):
    """Metric that describes images one by one and then compares the descriptors of two sets."""

    regions: tuple[str, ...]  # the pixels that it measures: "full", "object"

    def describe(self, images: Images, seeds: Sequence[int]) -> Descriptors:
        """Return descriptors of images with values in [0, 1]; random choices for an image depend on its seed only."""

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """Return figures by name; lower is better."""

    def settings(self) -> dict[str, Settings]:
        """Return the settings that figures depend on, by the figures' names."""


class ImageSets:
    """Descriptors that set metrics compare, by predictor, region and scene."""

    TRUE = "true"

    def __init__(self, metrics: Sequence[SetMetric]) -> None:
        self.metrics = metrics
        self.described: dict[tuple[str, str, int], dict[str, Descriptors]] = defaultdict(dict)

    def add(self, owner: str, region: str, scene: str, images: Images, seeds: Sequence[int]) -> None:
        """Describe images of a scene, by a predictor or `TRUE`, unless that scene has been described already."""
        for index, metric in enumerate(self.metrics):
            scenes = self.described[owner, region, index]
            if region in metric.regions and scene not in scenes:
                scenes[scene] = [kind.float().cpu() for kind in metric.describe(images, seeds)]

    def results(self, owner: str, region: str) -> dict[str, float]:
        """Return the distances of a predictor's images from the true images of the same scenes."""
        figures: dict[str, float] = {}
        for index, metric in enumerate(self.metrics):
            predicted, true = self.described[owner, region, index], self.described[self.TRUE, region, index]
            if predicted:
                parts = ([scenes[name] for name in sorted(predicted)] for scenes in (true, predicted))
                figures |= metric.distances(*([torch.cat(kind) for kind in zip(*part, strict=True)] for part in parts))
        return figures

    def merge(self, described: dict[tuple[str, str, int], dict[str, Descriptors]]) -> None:
        """Add the descriptors of another process."""
        for key, scenes in described.items():
            self.described[key] |= scenes


class Patches:
    """Sliced Wasserstein distance of `patches` patches per image and level, over all pixels, as "swd"."""

    regions = ("full",)

    def __init__(self, patches: int = 16) -> None:
        self.patches = patches

    def describe(self, images: Images, seeds: Sequence[int]) -> Descriptors:
        """See `SetMetric`."""
        return list(descriptors(images, seeds, self.patches))

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """See `SetMetric`."""
        return {"swd": sliced_wasserstein(true, predicted)}

    def settings(self) -> dict[str, Settings]:
        """See `SetMetric`."""
        return {"swd": {"patches": self.patches, "patch": 7, "projections": 512, "factor": 1000}}


class Inception:
    """FID and KID (over subsets of at most `subset_size` items), as "fid" and "kid", for all and for object pixels.

    `network` is a TorchScript Inception, which takes 8-bit images, resizes them itself and returns pool features. It is
    called as in NVlabs' `stylegan2-ada-pytorch/metrics`: `network(bytes, return_features=True)`.
    """

    regions = ("full", "object")

    def __init__(self, network: torch.jit.ScriptModule, subset_size: int = 1000) -> None:
        self.network, self.subset_size = network.eval(), subset_size

    @torch.no_grad()
    def features(self, images: Images) -> Float[Tensor, "image feature"]:
        """Return features (2048 of NVlabs' network) of sRGB images with values in [0, 1], rounded to 8 bits."""
        pixels = (255 * images.clamp(0, 1)).round().to(torch.uint8)
        with torch.autocast(images.device.type, enabled=False):
            features: Tensor = self.network.to(images.device)(pixels, return_features=True).float()
        return features

    def describe(self, images: Images, seeds: Sequence[int]) -> Descriptors:
        """See `SetMetric`; nothing is random here."""
        return [self.features(images)]

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """See `SetMetric`."""
        (a,), (b,) = true, predicted
        return {"fid": frechet_distance(a, b), "kid": kernel_distance(a, b, self.subset_size)}

    def settings(self) -> dict[str, Settings]:
        """See `SetMetric`."""
        network = {"network": "inception-2015-12-05", "features": "pool, 2048"}
        return {"fid": network, "kid": network | {"subset_size": self.subset_size, "subsets": 100, "factor": 1}}


def inception(weights: str | None, sha256: str | None = None, subset_size: int = 1000) -> Inception | Missing:
    """Return FID and KID, or why they are missing; see `load_inception` for the weights."""
    load = lambda source: load_inception(source, sha256, subset_size)  # noqa: E731
    return unless_missing(weights, load, ADVICE, ("fid", "kid"))


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


def frechet_distance(first: Float[Tensor, "first feature"], second: Float[Tensor, "second feature"]) -> float:
    """Return the squared Frechet distance of normal distributions fitted to two sets (Heusel et al. 2017, Eq. 6).

    It is computed in float64 and needs far more items than features. Values for sets of different sizes do not compare.
    """
    from torchmetrics.image.fid import FrechetInceptionDistance

    identity = nn.Identity()
    identity.num_features = first.shape[1]  # type: ignore[assignment]
    # The sets are complete; among several processes torchmetrics would wait for the others' sets and add them.
    metric = FrechetInceptionDistance(identity, sync_on_compute=False).to(first.device)
    metric.update(first.double(), real=True)
    metric.update(second.double(), real=False)
    return metric.compute().item()


def kernel_distance(
    first: Float[Tensor, "first feature"],
    second: Float[Tensor, "second feature"],
    subset_size: int = 1000,
    subsets: int = 100,
    seed: int = 0,
) -> float:
    """Return the squared maximum mean discrepancy, unbiased, so at times below 0 (Binkowski et al. 2018, Section 4).

    The kernel is (x.y / features + 1)^3. The value is a mean over random subsets of at most `subset_size` items, in
    float64, not times 1000. It depends on the order of the items if a set is larger than a subset.
    """
    from torchmetrics.image.kid import poly_mmd

    size = min(subset_size, len(first), len(second))
    generator = torch.Generator().manual_seed(seed)
    values = []
    for _ in range(subsets):
        a, b = (x[torch.randperm(len(x), generator=generator)[:size].to(x.device)] for x in (first, second))
        values.append(poly_mmd(a.double(), b.double()))
    return torch.stack(values).mean().item()


# Karras et al. 2018, "Progressive Growing of GANs", Section 5: patches of 7 x 7 pixels from every level down to 16
# pixels, 128 per image and level, each channel normalised to mean 0 and standard deviation 1 over its set, 512
# projections (four times 128 in their `metrics/sliced_wasserstein.py`).
Items = Float[Tensor, "item feature"]
PATCH, SMALLEST_SIDE, PROJECTIONS, REPEATS = 7, 16, 128, 4
SMALLEST_DEVIATION = 1e-4  # 1/40 of an 8-bit step: less is rounding and is not scaled up


def laplacian_pyramid(images: Float[Tensor, "image 3 height width"]) -> list[Float[Tensor, "image 3 _ _"]]:
    """Return Burt and Adelson's pyramid: full resolution first, then halved levels, a small image last."""
    if min(images.shape[-2:]) < SMALLEST_SIDE:
        raise ValueError(f"needs images of at least {SMALLEST_SIDE} pixels")
    levels = []
    while min(images.shape[-2:]) >= 2 * SMALLEST_SIDE:
        smaller = _blur(images)[..., ::2, ::2]
        levels.append(images - expand(smaller, images.shape[-2:]))
        images = smaller
    return [*levels, images]


def expand(images: Float[Tensor, "image 3 _ _"], size: Sequence[int]) -> Float[Tensor, "image 3 _ _"]:
    """Double images to `size` (height and width, which must be stated because either may be odd)."""
    spread = images.new_zeros(*images.shape[:2], *size)
    spread[..., ::2, ::2] = images
    return 4 * _blur(spread)


def _blur(images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image 3 height width"]:
    weights = images.new_tensor([1, 4, 6, 4, 1]) / 16
    kernel = torch.outer(weights, weights).expand(3, 1, 5, 5)
    return conv2d(pad(images, (2, 2, 2, 2), mode="reflect"), kernel, groups=3)


def descriptors(
    images: Float[Tensor, "image 3 height width"], seeds: Sequence[int], patches: int = 128
) -> list[Float[Tensor, "descriptor 147"]]:
    """Return patches of each pyramid level, not yet normalised; a level's patches of all images are one tensor.

    An image's patches depend on the image and its seed only, so several processes may describe parts of a set. A
    prediction and its truth share their seeds.

    Raises:
        ValueError: the images are smaller than 16 pixels.
    """
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    rows = torch.arange(len(images), device=images.device)[:, None]
    described = []
    for level in laplacian_pyramid(images.float()):
        windows = level.unfold(2, PATCH, 1).unfold(3, PATCH, 1)
        # Top and left of each patch: [2 image patch].
        places = [[torch.randint(n, (patches,), generator=g) for g in generators] for n in windows.shape[2:4]]
        top, left = (torch.stack(offsets).to(images.device) for offsets in places)
        described.append(windows[rows, :, top, left].flatten(0, 1).flatten(1))
    return described


def sliced_wasserstein(first: Sequence[Float[Tensor, "_ 147"]], second: Sequence[Float[Tensor, "_ 147"]]) -> float:
    """Return the mean distance over the levels of two sets' descriptors, times 1000 as in the paper's tables.

    It ignores brightness and contrast, because each set is normalised. The projections are always the same.
    """
    generator = torch.Generator().manual_seed(0)
    distances = []
    for a, b in zip(first, second, strict=True):
        sets = _normalized(a), _normalized(b)
        distances += [projected_distance(*sets, PROJECTIONS, generator) for _ in range(REPEATS)]
    return 1000 * torch.stack(distances).mean().item()


def projected_distance(first: Items, second: Items, projections: int, generator: torch.Generator) -> Float[Tensor, ""]:
    """Return the 1-Wasserstein distance of equal-sized sets on a line, mean over directions (Rabin et al. 2011)."""
    directions = torch.randn(projections, first.shape[1], generator=generator)
    directions = (directions / directions.norm(dim=1, keepdim=True)).to(first)
    a, b = ((directions @ x.T).sort(1).values for x in (first, second))
    return torch.mean((a - b).abs())


def _normalized(patches: Float[Tensor, "descriptor 147"]) -> Float[Tensor, "descriptor 147"]:
    """Subtract each channel's mean and divide by its standard deviation."""
    channels = patches.reshape(-1, 3, PATCH * PATCH)
    deviation, mean = torch.std_mean(channels, dim=(0, 2), correction=0, keepdim=True)
    return torch.flatten((channels - mean) / deviation.clamp(min=SMALLEST_DEVIATION), 1)
