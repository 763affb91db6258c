"""Import of captures: a check of their cameras, or cameras for photos or a video, by COLMAP or of a turntable."""

import logging
import re
import shlex
import subprocess
from collections.abc import Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Literal, Unpack

from PIL import ImageOps
from rich.progress import Progress, track

from completesplat.data.captures.captured_frames import FEWEST_FRAMES, import_pycolmap
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.captures.turntable import TurntableSettings, import_turntables
from completesplat.data.sequences import first_names
from completesplat.data.validation.processes import usable_cores
from completesplat.errors import DataError, refused_to
from completesplat.files import atomic_folder
from completesplat.photo import files, saving
from completesplat.quantities import Positive
from completesplat.wording import by_numbers, counted, folder_names

logger = logging.getLogger(__name__)
leave_out = partial(logger.warning, "left out: %s")

MOST_FEATURES = 4096  # of an image; the time of matching grows with their square
MOST_WITH_ALL_PAIRS = 100  # photos; of more, as of a video, neighbours are matched
NEAR = 10  # frames


def import_capture(
    folder: str,
    cameras: Literal["colmap", "turntable"] | None,
    frames: Positive,
    max_image_size: Positive,
    out: Path,
    **turntable: Unpack[TurntableSettings],
) -> str:
    """Check the cameras of captures, which COLMAP or a turntable may give first, and return the next command."""
    if cameras == "turntable":
        import_turntables(Path(folder), out, turntable)
        return f"go on with: completesplat data show data=turntable {shlex.quote(f'data.root={out}')}"
    root = Path(folder) if cameras is None else _make_capture(Path(folder), frames, max_image_size, out)
    sources = CaptureDataModule(str(root)).open("train")
    for error in sources["train"].refused:
        leave_out(error)
    for name in sources["train"].names:
        sources["train"].check(name)
        counts = [len(sources[split].read(name).frames) for split in ("train", "test")]
        logger.info("%s: %d images with cameras, of which %d are held out", name, sum(counts), counts[1])
    names = sources["train"].names
    first = root if len(names) == 1 else root / names[0]  # of several captures
    return f"go on with: completesplat fit experiment=capture {shlex.quote(f'data.root={first}')}"


def _make_capture(source: Path, frames: int, max_image_size: int, out: Path) -> Path:
    """Write and return `out`/NAME, whole or not at all, and name the images that have no pose."""
    if not source.exists():
        raise DataError("no such file or folder", str(source))
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    video = source.is_file()
    path = source.resolve()
    capture = out / (path.stem if video else path.name)
    if capture.exists():
        raise DataError("exists already: import it without cameras=colmap, or choose another out=DIR", str(capture))
    with atomic_folder(capture) as unfinished:
        images = unfinished / "images"
        images.mkdir()
        if video:
            _split_video(source, images, frames)
        else:
            _copy_photos(source / "images" if (source / "images").is_dir() else source, images)
        paths = (path.relative_to(images) for path in images.rglob("*.*") if path.is_file())
        names = [path.as_posix() for path in sorted(paths, key=by_numbers)]
        if len(names) < FEWEST_FRAMES:
            raise DataError(f"{len(names)} usable images; a capture needs {FEWEST_FRAMES}", str(source))
        posed = _find_cameras(unfinished, names, video or len(names) > MOST_WITH_ALL_PAIRS, max_image_size)
        result = f"COLMAP finds poses for {len(posed)} of {len(names)} images"
        if len(posed) < FEWEST_FRAMES:
            advice = "take more of one still, textured scene, each overlapping the one before"
            raise DataError(f"{result}; a capture needs {FEWEST_FRAMES}: {advice}", str(source))
        lost = [name for name in names if name not in posed]
        if lost:
            result = f"{result}, and leaves out: {', '.join(lost)}"
        logger.info(result)
    return capture


def _copy_photos(folder: Path, images: Path) -> None:
    """Write upright photos, with the rest of their EXIF records, which has the focal length.

    Photos of folders below are written into folders, each the photos of one camera.
    """
    formats = files.photo_formats()
    photos = _photos_in(folder, formats)
    # COLMAP lists pairs with a space between.
    folders = sorted({photo.parent for photo in photos})
    names = dict(zip(folders, folder_names("_".join(path.name.split()) for path in folders), strict=True))
    stems = folder_names("_".join(path.stem.split()) for path in photos)
    for photo, stem in track(list(zip(photos, stems, strict=True)), "photos"):
        with refused_to(leave_out), files.refused_as_bad(str(photo)):
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
        advice = "" if "HEIF" in formats else files.NEEDS_HEIC
        logger.warning("left out: %s of other formats: %s%s", counted(len(unread), "file"), first_names(unread), advice)
    return photos


def _split_video(video: Path, images: Path, frames: int) -> None:
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


def image_pairs(images: int, sequential: bool) -> list[tuple[int, int]]:
    """Return the pairs to match: all, or, in a ring of images, those at most `NEAR` or a power of two apart."""
    pairs = ((a, b, min(b - a, images - b + a)) for a, b in combinations(range(images), 2))
    return [(a, b) for a, b, apart in pairs if not sequential or apart <= NEAR or apart.bit_count() == 1]


def _find_cameras(folder: Path, names: list[str], sequential: bool, max_image_size: int) -> set[str]:
    """Write COLMAP's largest model as `folder`/sparse/0 and return its images.

    The images of a folder share a lens if all have the same size.
    """
    pycolmap = import_pycolmap()
    images = folder / "images"
    database = folder / "db"
    pairs = folder / "pairs"
    at_a_time = usable_cores()
    pycolmap.Database.open(database).close()
    sizes = {(Path(name).parent, files.stored_size(images / name, name)) for name in names}
    uniform = len(sizes) == len({Path(name).parent for name in names})
    mode = pycolmap.CameraMode.PER_FOLDER if uniform else pycolmap.CameraMode.PER_IMAGE
    pycolmap.import_images(database, images, mode, names)
    extraction = pycolmap.FeatureExtractionOptions()
    pairing = pycolmap.ImportedPairingOptions()
    extraction.max_image_size = max_image_size
    extraction.sift.max_num_features = MOST_FEATURES
    for start in track(range(0, len(names), at_a_time), "features"):
        chunk = names[start : start + at_a_time]
        pycolmap.extract_features(database, images, chunk, extraction_options=extraction)
    lines = [f"{names[a]} {names[b]}\n" for a, b in image_pairs(len(names), sequential)]
    pairing.match_list_path = pairs
    for start in track(range(0, len(lines), 10 * at_a_time), "matches"):
        pairs.write_text("".join(lines[start : start + 10 * at_a_time]))
        pycolmap.match_image_pairs(database, pairing_options=pairing)
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed = 0
    (folder / "sparse/0").mkdir(parents=True)
    with Progress() as progress:
        bar = progress.add_task("poses", total=len(names))
        models = pycolmap.incremental_mapping(
            database,
            images,
            folder / "sparse",
            mapping,
            "",
            lambda: progress.advance(bar, 2),  # the first pair of images has a pose
            lambda: progress.advance(bar),
        )
    model = max(models.values(), key=pycolmap.Reconstruction.num_reg_images, default=pycolmap.Reconstruction())
    model.write_binary(folder / "sparse/0")
    database.unlink()
    pairs.unlink()
    return {image.name for image in model.images.values() if image.has_pose}
