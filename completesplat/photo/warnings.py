"""Warnings about a photo from which scenes are likely to be wrong."""

import math
from collections.abc import Mapping
from typing import Any

from completesplat.photo.choice import match_shipped
from completesplat.photo.features import distance_to_training
from completesplat.photo.reading import Photograph

FAR = 1.5  # ratio of tan(fov / 2), photo to training, from which a warning is given
UNLIKE = 2.0  # distance from the training images (`distance_to_training`) from which a warning is given
RESIZING = 0.1  # change of a distance that resizing to another model's size and back may cause
ELSEWHERE = (
    "other objects: try weights=splatter_image:objaverse, a download of 226 MB; "
    "whole places: try https://github.com/apple/ml-sharp"
)


def photo_warnings(photograph: Photograph, training: Mapping[str, Any], trained_degrees: float) -> list[str]:
    """Return lines about a photo that is unlike the training images.

    Args:
        training: facts about the training images (`TrainingImages`). Contents are compared only if nothing is hidden.
        trained_degrees: field of view of the training images.
    """
    lines = []
    if "depth_before" not in training:  # with it, the depth range follows the field of view
        line = unusual_field_of_view(photograph, trained_degrees)
        lines += [] if line is None else [line]
    middle = photograph.middle_at(photograph.image.shape[-1])
    distance = None if photograph.visible is not None else distance_to_training(middle, training)
    if distance is not None and distance > UNLIKE:
        far = f"{distance:.1f} standard deviations away, where {UNLIKE:g} is far"
        lines.append(f"this photo is unlike the training images ({far}): its scenes will look little like it")
        advice = nearer_weights(photograph, distance)
        lines += [] if advice is None else [advice]
    return lines


def nearer_weights(photograph: Photograph, distance: float) -> str | None:
    """Name the shipped weights whose training images are nearer to a photo, and `ELSEWHERE` if these are far, too."""
    matches = match_shipped(photograph.middle_at(photograph.image.shape[-1]))
    name = next(iter(matches), "")
    other = matches[name].distance if matches else math.inf
    parts = []
    if other < distance - RESIZING:
        parts.append(f"weights={name} were trained on images that are nearer ({other:.1f})")
    if min(other, distance) > UNLIKE:
        parts.append(ELSEWHERE)
    return "; ".join(parts) or None


def unusual_field_of_view(photograph: Photograph, trained_degrees: float) -> str | None:
    """Return a warning if the field of view is far from that in training: tan(fov / 2) differs by 1.5 times or more.

    The networks see pixels, not angles, and put them at the depths that they have learnt. Lengths across the image
    grow with the tangent, lengths along the depth do not. So the proportions are wrong by the ratio of the tangents.
    """
    tangent = math.tan(math.radians(photograph.fov_degrees) / 2)
    ratio = tangent / math.tan(math.radians(trained_degrees) / 2)
    if 1 / FAR < ratio < FAR:
        return None
    wrong = f"{ratio:.1f} times too flat" if ratio > 1 else f"{1 / ratio:.1f} times too deep"
    source = "given" if photograph.fov_source == "given" else "from EXIF; fov=DEGREES overrides it"
    return (
        f"the field of view is {photograph.fov_degrees:.0f} degrees ({source}), {trained_degrees:.0f} in training:"
        f" expect shapes about {wrong}"
    )


def hidden_parts_warning(training: Mapping[str, Any], mask: object, box: object) -> str | None:
    """Return a warning if a mask or box is given to weights that were not trained with parts of the image hidden."""
    if training.get("box_masks") or (mask is None and box is None):
        return None
    setting = "box" if mask is None else "mask"
    return (
        f"{setting}: these weights were not trained with parts of the image hidden (data.box_masks,"
        " conf/experiment/*_masked.yaml): hidden parts may come out black or grey"
    )
