"""The pictures that a person names, and a folder for what is made of each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError

SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".avif"),
    *(".jp2", ".bmp", ".gif", ".ppm", ".pgm", ".pnm"),
)


def find_pictures(image: Any) -> list[Path]:
    """The files of `image=FILE`, `image=FOLDER` or a list of both; of a folder its pictures, sorted by name.

    A folder's pictures are known by their suffix, and its folders are left alone. Files that are named themselves are
    taken as they are, missing ones too: reading them says what is wrong.

    Raises:
        CompleteSplatError: a folder without a picture, or an empty list.
    """
    found: list[Path] = []
    for path in [Path(image)] if isinstance(image, str) else [Path(str(one)) for one in image]:
        if not path.is_dir():
            found.append(path)
            continue
        pictures = sorted(one for one in path.iterdir() if one.is_file() and one.suffix.lower() in SUFFIXES)
        if not pictures:
            raise CompleteSplatError(f"{path}: no picture in this folder ({', '.join(SUFFIXES)})")
        found += pictures
    if not found:
        raise CompleteSplatError("image=[]: name at least one picture")
    return found


def folder_names(pictures: Sequence[Path]) -> list[str]:
    """A name for each picture's folder: its stem, and for a stem that is taken `_2`, `_3` and so on behind it.

    Capitals do not tell names apart, because they do not on every file system.
    """
    names: list[str] = []
    taken: set[str] = set()
    for picture in pictures:
        name, number = picture.stem, 2
        while name.casefold() in taken:
            name, number = f"{picture.stem}_{number}", number + 1
        taken.add(name.casefold())
        names.append(name)
    return names
