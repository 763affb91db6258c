"""The settings of `completesplat predict`: which have a meaning, and which files they ask for."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from completesplat.autoreconstructor.skips import allowed_skip_weight
from completesplat.diffusion.guidance import check_guidance_weight
from completesplat.errors import CompleteSplatError
from completesplat.export.formats import CONVERTED, FORMATS
from completesplat.export.prediction import Wanted
from completesplat.export.splat_transform import find_splat_transform
from completesplat.geometry.trajectories import PATHS


def check_settings(config: Any) -> None:
    """Refuse settings without a meaning.

    Raises:
        CompleteSplatError: names the setting and its range.
    """
    allowed_skip_weight(config.skip_weight)
    check_guidance_weight(config.guidance_weight)
    if not 0 <= config.background <= 1:
        raise CompleteSplatError(f"background={config.background}: must lie between 0 and 1")
    for name in ("samples", "frames", "batch"):
        if config[name] is not None and config[name] < 1:
            raise CompleteSplatError(f"{name}={config[name]}: must be at least 1")
    if config.steps is not None and not 1 <= config.steps <= 1000:
        raise CompleteSplatError(f"steps={config.steps}: must lie between 1 and 1000")


def wanted_files(config: Any) -> Wanted:
    """What to write of each picture; looks for the converter if a format needs it.

    Raises:
        CompleteSplatError: no such format or camera path, no format at all, or no converter.
    """
    formats = _chosen("formats", config.formats, FORMATS)
    if not formats:
        raise CompleteSplatError(f"formats=[]: choose from {', '.join(FORMATS)}")
    return Wanted(
        formats=formats,
        videos=_chosen("video", config.video, tuple(PATHS)),
        frames=config.frames,
        background=config.background,
        maps=config.maps,
        widen=config.widen,
        converter=find_splat_transform() if set(formats) & set(CONVERTED) else None,
    )


def _chosen(name: str, value: Any, choice: Sequence[str]) -> tuple[str, ...]:
    """One name or a list of them, each once."""
    names = [value] if isinstance(value, str) else list(value or [])
    for one in names:
        if one not in choice:
            raise CompleteSplatError(f"{name}={one}: choose from {', '.join(choice)}")
    return tuple(dict.fromkeys(names))


def visible_part(config: Any, image: Path, size: int) -> Any:
    """[1 size size], 0 where `mask` or `box` hide the photograph; None without them.

    Raises:
        ImageError: the mask is not a readable picture.
        CompleteSplatError: mask and box at once, a box that is none, or a mask that hides nothing.
    """
    from completesplat.data.masking import outside_of_box, outside_of_mask

    if config.mask is not None and config.box is not None:
        raise CompleteSplatError("give mask=FILE or box=[x0,y0,x1,y1], not both")
    if config.mask is not None:
        return outside_of_mask(image, Path(config.mask), size)
    if config.box is None:
        return None
    if isinstance(config.box, str | int | float) or not all(isinstance(edge, int | float) for edge in config.box):
        raise CompleteSplatError(f"box={config.box}: give [x0,y0,x1,y1]")
    return outside_of_box(image, list(config.box), size)
