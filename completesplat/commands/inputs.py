"""Files that verbs are given, found before torch is imported, because a wrong name should not take seconds."""

import os
from collections.abc import Sequence
from glob import glob
from pathlib import Path

from omegaconf import DictConfig

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.weights import AUTO, check_name
from completesplat.wording import printable

SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".png",
    ".webp",
    ".tif",
    ".tiff",
    ".avif",
    ".jp2",
    ".bmp",
    ".gif",
    ".ppm",
    ".pgm",
    ".pnm",
    ".heic",
    ".heif",
)


def check_inputs(verb: str, config: DictConfig) -> None:
    """Raise CompleteSplatError if an image, weights or a checkpoint are not there, or `test` is given no model."""
    if verb == "predict":
        find_images(config.image)
    # `auto` chooses weights when the image is read, and names of published weights (with a colon) are checked later.
    if verb in ("predict", "view") and config.weights != AUTO and ":" not in config.weights:
        check_name(config.weights)
    if verb == "export":
        check_name(config.weights)
    if verb == "test":
        check_one_model(config.ckpt, config.weights, config.scenes)
        if config.ckpt is not None and not os.path.exists(config.ckpt):
            raise WeightsError(f"{config.ckpt}: no such checkpoint")


def check_one_model(ckpt: str | None, weights: str | None, scenes: str | None) -> None:
    """Raise CompleteSplatError unless exactly one of them is given."""
    if [ckpt, weights, scenes].count(None) != 2:
        raise CompleteSplatError("give one of ckpt=FILE, weights=DIR and scenes=DIR; all but ckpt need data=NAME")


def find_images(image: object) -> list[Path]:
    """Return the files of `image=FILE`, or the images, sorted, of `image=FOLDER` or `image=PATTERN`, or of a list.

    Raises:
        CompleteSplatError: no file exists, a folder or pattern has no image, the list is empty, or an entry is no name.
    """
    entries = entries_of(image)
    if not entries:
        raise CompleteSplatError("image=[]: name at least one image")
    # Hydra reads a file name of digits as a whole number.
    if any(entry == "" or isinstance(entry, bool) or not isinstance(entry, str | int) for entry in entries):
        raise CompleteSplatError(f"image={image}: give an image, a folder, or a list of them")
    images = [path for entry in entries for path in _images_of(Path(str(entry)))]
    if not any(map(os.path.lexists, images)):
        raise CompleteSplatError(f"{printable(str(images[0])[:300])}: no such file")
    return images


def left_out(image: object, images: Sequence[Path]) -> list[str]:
    """Return the names of other files, without hidden ones, in folders that are given as `image`."""
    folders = [Path(str(entry)) for entry in entries_of(image) if os.path.isdir(str(entry))]
    files = {file for folder in folders for file in folder.glob("[!.]*") if file.is_file()}
    return sorted(file.name for file in files.difference(images))


def entries_of(image: object) -> Sequence[object]:
    """Return the entries of the setting `image`, which is one of them or a list."""
    return image if isinstance(image, Sequence) and not isinstance(image, str) else [image]


def _images_of(path: Path) -> list[Path]:
    # `os.path`, because the methods of `Path` raise an error if a name is too long.
    folder = os.path.isdir(path)
    if not folder and (os.path.lexists(path) or not set("*?[") & set(str(path))):
        return [path]
    try:
        files = path.iterdir() if folder else map(Path, glob(str(path), recursive=True))
        # Archives of macOS have a file `._NAME` for each file.
        named = (file for file in files if file.suffix.lower() in SUFFIXES and not file.name.startswith("._"))
        images = sorted(file for file in named if file.is_file())
    except OSError as error:
        raise CompleteSplatError(f"{path}: {error.strerror}") from error
    if not images:
        where = f"in this folder (for those below it: image='{path}/**')" if folder else "fits"
        raise CompleteSplatError(f"{path}: no image {where}: {', '.join(SUFFIXES)}")
    return images
