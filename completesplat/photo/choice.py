"""Choice of the weights in the package that are likeliest for photos."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.errors import ImageError, WeightsError
from completesplat.photo.features import distance_to_training, image_features
from completesplat.photo.reading import Framing, ImageLike, read_square
from completesplat.weights import CONFIG_FILE, read_small, shipped
from completesplat.wording import printable

Item = TypeVar("Item")
LOOKED_AT = 8  # at most this many of the images are examined
SAME_GREY = 0.1  # largest difference of a border's pixel from the background
BACKGROUND_SHARE = 0.5  # of the border's pixels, at least, if an object lies on the background


class Match(NamedTuple):
    """Fit of an image to weights: the probability that it is of their kind, and its `distance_to_training`."""

    probability: float
    distance: float


def likeliest_weights(images: Sequence[Path], remove_background: bool) -> tuple[str, str]:
    """Return `likeliest_for` of some of the images (`looked_at`)."""
    named = [(image.name, image) for image in looked_at(images)]
    return likeliest_for(named, len(images), remove_background)


def looked_at(items: Sequence[Item]) -> Sequence[Item]:
    """Return at most `LOOKED_AT` of the items, from all over."""
    step = math.ceil(len(items) / LOOKED_AT) or 1
    return items[::step]


def likeliest_for(
    images: Sequence[tuple[str, ImageLike]], number: int, remove_background: bool = False
) -> tuple[str, str]:
    """Return the name of the likeliest shipped weights for some of `number` images, and the reason as a clause.

    Without an image, they are those for photos of anything.

    Args:
        images: name and content of each image.

    Raises:
        WeightsError: the package has no weights.
    """
    if not shipped():
        raise WeightsError("weights=auto: this package has no weights; give weights=DIR")
    sums = Counter[str]()
    names = list[str]()
    for name, image in images:
        with suppress(ImageError, OSError):  # which ends the prediction of this image alone, when its turn comes
            matches = match_shipped(image, remove_background)
            sums.update({weights: match.probability for weights, match in matches.items()})
            names.append(printable(name))
    if not names:
        return _without_images(bool(images))
    shares = [f"{weights} {total / len(names):.0%}" for weights, total in sums.most_common()]
    shares += [f"{weights} needs a plain background" for weights in shipped() if weights not in sums]
    whose = names[0] if number == 1 else f"{len(names)} of {number} images"
    return sums.most_common(1)[0][0], f"; the likeliest for {whose}: {', '.join(shares)}"


def _without_images(unreadable: bool) -> tuple[str, str]:
    name, *others = shipped_configs()
    why = "no image can be read" if unreadable else "there is no image to choose by"
    choices = " or ".join(f"weights={other}" for other in others)
    return name, f"; taken because {why}, or give {choices}"


def match_shipped(image: ImageLike, remove_background: bool = False) -> dict[str, Match]:
    """Return how an image fits the weights in the package, the likeliest first.

    Training images are taken as normally distributed, with `log_odds` before the image is seen. Weights with
    `feature_odds` state their odds against those for photos of anything themselves. Distances depend on the resolution,
    so the image, which is read once, is resized for each model. Weights of objects on one background are left out if
    the image's border does not show it.

    Raises:
        CompleteSplatError: as `read_square`.
    """
    configs = shipped_configs()
    largest = max((config["image_size"] for config in configs.values()), default=1)
    framing = Framing(largest, whole_object=True)
    square = read_square(image, framing, remove_background=remove_background, crop="center").image
    distances = dict[str, float]()
    logarithms = list[float]()
    for name, config in configs.items():
        training = config["training"]
        background = training.get("background")
        if background is not None and not _lies_on(background, square):
            continue
        resized = read_square(square, Framing(config["image_size"])).image
        distance = distance_to_training(resized, training)
        if distance is not None:
            standard_deviations = torch.tensor(training["picture_std"])
            # Log density of independent normal features, without its constant. `distance` squared is the mean over the
            # features of their squared distances from the mean, in standard deviations.
            density = -standard_deviations.log().sum().item() - len(standard_deviations) * distance**2 / 2
            if "feature_odds" in training:
                of_anything = logarithms[0] if logarithms else 0.0
                density = of_anything + (image_features(resized) @ torch.tensor(training["feature_odds"])).item()
            distances[name] = distance
            logarithms.append(density + training.get("log_odds", 0.0))
    probabilities = torch.tensor(logarithms, dtype=torch.float64).softmax(0).tolist()
    matches = {name: Match(share, distances[name]) for name, share in zip(distances, probabilities, strict=True)}
    return dict(sorted(matches.items(), key=lambda item: -item[1].probability))


def shipped_configs() -> dict[str, Any]:
    """Return the configs of the weights in the package by name, those for photos of anything first.

    Only specialised weights store `log_odds`, how likely a photo is of their kind before it is seen. The weights for
    photos of anything are what the odds compare them with, so they store none.
    """
    configs = {name: json.loads(read_small(folder / CONFIG_FILE)) for name, folder in shipped().items()}
    return dict(sorted(configs.items(), key=lambda item: "log_odds" in item[1]["training"]))


def _lies_on(background: float, square: Float[Tensor, "3 size size"]) -> bool:
    """Return whether at least half of an image's border has about this grey value."""
    rows = square[:, [0, -1]].flatten(1)
    columns = square[:, :, [0, -1]].flatten(1)
    border = torch.cat([rows, columns], dim=1)
    same = (border - background).abs().amax(0) < SAME_GREY
    return same.float().mean().item() >= BACKGROUND_SHARE
