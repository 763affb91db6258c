"""Images of a capture that COLMAP can read, from photos or from a video."""

import logging
import re
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from PIL import ImageOps
from rich.progress import track

from completesplat.data.sequences import first_names
from completesplat.errors import DataError, refused_to
from completesplat.photo import files, saving
from completesplat.wording import counted, folder_names

logger = logging.getLogger(__name__)


def copy_photos(folder: Path, images: Path) -> None:
    """Write upright photos, with the rest of their EXIF records, which has the focal length.

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
            if upright.mode in ("CMYK", "YCbCr"):
                upright = upright.convert("RGB")
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


def split_video(video: Path, images: Path, frames: int) -> None:
    """Write the first frame of each of equal parts of a video, or all frames if there are fewer."""
    from imageio_ffmpeg import get_ffmpeg_exe

    limit = "-max_pixels", str(files.MOST_PIXELS)  # else a small file could take gigabytes
    start = [get_ffmpeg_exe(), "-nostdin", *limit, "-i", str(video.absolute())]
    output = subprocess.run([*start, "-map", "0:v:0", "-f", "null", "-"], capture_output=True).stderr
    count = int((re.findall(rb"frame= *(\d+)", output) or [b"0"])[-1])
    if not count:
        raise DataError(f"ffmpeg finds no video of at most {files.MOST_PIXELS:,} pixels there", str(video))
    part = f"{min(frames, count)}/{count}"
    options = ["-vf", f"select=gt(floor(n*{part})\\,floor((n-1)*{part}))", "-fps_mode", "passthrough", "-q:v", "2"]
    if subprocess.run([*start, "-v", "error", *options, "%05d.jpg"], cwd=images).returncode:
        raise DataError("ffmpeg cannot split it; the reason is above", str(video))
