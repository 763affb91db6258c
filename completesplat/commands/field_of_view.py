"""Whether a photograph's field of view is one that a model has learnt from."""

import math

from completesplat.data.photograph import Photograph

FAR = 1.5


def unusual_field_of_view(photograph: Photograph, trained_degrees: float) -> str | None:
    """What to tell if the field of view is far from training's: if the tangents of half of it differ 1.5 times or more.

    The networks see pixels, not angles, and put them at the depths that they have learnt. Across the picture lengths
    go with the tangent, along the depth they do not: so the ratio of the tangents is that of the wrong proportions.
    """
    own, trained = (math.tan(math.radians(fov) / 2) for fov in (photograph.fov_degrees, trained_degrees))
    ratio = own / trained
    if 1 / FAR < ratio < FAR:
        return None
    wrong = f"{ratio:.1f} times too flat" if ratio > 1 else f"{1 / ratio:.1f} times too deep"
    source = "given" if photograph.fov_source == "given" else "from EXIF; fov=DEGREES overrides it"
    return (
        f"the field of view is {photograph.fov_degrees:.0f} degrees ({source}), {trained_degrees:.0f} in training:"
        f" expect shapes about {wrong}"
    )
