"""Images of a capture that COLMAP can read, from photos."""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from PIL import ImageOps
from rich.progress import track

from completesplat.data.sequences import first_names
from completesplat.errors import refused_to
from completesplat.photo import files, saving
from completesplat.wording import counted, folder_names

logger = logging.getLogger(__name__)


def copy_photos(folder: Path, images: Path) -> None:
    """Write upright photos in sRGB, with the rest of their EXIF records, which has the focal length.

    Photos of folders below are written into folders, each the photos of one camera.
    """
    formats = files.photo_formats()
    photos = _photos_in(folder, formats)
    folders = sorted({photo.parent for photo in photos})
    # No name has a space, because COLMAP's list of pairs has a space between two names.
    names = dict(zip(folders, folder_names("_".join(path.name.split()) for path in folders), strict=True))
    stems = folder_names("_".join(path.stem.split()) for path in photos)
    for photo, stem in track(list(zip(photos, stems, strict=True)), "photos"):
        with refused_to(partial(logger.warning, "left out: %s")), files.refused_as_bad(str(photo)):
            with files.open_image(photo, formats) as image:
                files.check_sums(image, photo)
                upright = ImageOps.exif_transpose(image)
            options = {"quality": 95, "subsampling": 0, "exif": upright.info.get("exif", b"")}
            place = images if photo.parent == folder else images / names[photo.parent]
            place.mkdir(exist_ok=True)
            profiled = "icc_profile" in upright.info and upright.mode in files.EIGHT_BIT_MODES
            if profiled or upright.mode in ("CMYK", "YCbCr"):
                upright = files.in_srgb(upright)
            lossy = image.format in ("JPEG", "MPO", "HEIF", "WEBP") and upright.mode in ("L", "RGB")
            suffix = ".jpg" if lossy else ".png"
            saving.save_image(upright, place / f"{stem}{suffix}", **options)


def _photos_in(folder: Path, formats: Sequence[str]) -> list[Path]:
    """Return the photos in a folder or, if there are none, in the folders below it, and name files of other formats."""
    folders = [folder]
    below = sorted(folder.glob("[!.]*/"))
    photos = files.image_files(folder, formats)
    if not photos:
        photos = [photo for path in below for photo in files.image_files(path, formats)]
        folders = below if photos else [folder, *below]
    present = {path for searched in folders for path in searched.glob("[!.]*") if path.is_file()}
    unread = sorted({path.name for path in present.difference(photos)})
    if unread:
        logger.warning("left out: %s of other formats: %s", counted(len(unread), "file"), first_names(unread))
    return photos
