"""Import of captures, whose cameras are checked.

Photos and videos without cameras get them first: COLMAP finds them, and those of a turntable are known.
"""

import json
import logging
import shlex
import shutil
from itertools import combinations
from pathlib import Path
from typing import Literal, Unpack

from rich.progress import Progress, track

from completesplat.data.captures.capture_images import copy_photos
from completesplat.data.captures.captured_frames import FEWEST_FRAMES, import_pycolmap
from completesplat.data.captures.conventions import AXES, MATRICES, to_camera_to_world
from completesplat.data.captures.films import split_video
from completesplat.data.captures.module import TRANSFORMS, CaptureDataModule
from completesplat.data.captures.turntable import TurntableSettings, import_turntables
from completesplat.data.validation import field, finite_array, read_json
from completesplat.data.validation.processes import usable_cores
from completesplat.errors import CompleteSplatError, DataError, errors_at
from completesplat.files import atomic_folder
from completesplat.photo import files
from completesplat.quantities import Positive
from completesplat.wording import by_numbers

logger = logging.getLogger(__name__)

MOST_FEATURES = 4096  # of an image; the time of matching grows with their square
MOST_WITH_ALL_PAIRS = 100  # photos; of more, as of a video, neighbours are matched
NEAR = 10  # frames


def import_capture(
    folder: str,
    cameras: Literal["colmap", "turntable"] | None,
    frames: Positive,
    max_image_size: Positive,
    out: Path,
    axes: Literal["opengl", "opencv"] = "opengl",
    matrices: Literal["camera_to_world", "world_to_camera"] = "camera_to_world",
    **turntable: Unpack[TurntableSettings],
) -> str:
    """Check the cameras of captures, or find the cameras of photos or a video first, and return the next command."""
    if cameras == "turntable":
        import_turntables(Path(folder), out, turntable)
        return f"go on with: completesplat data show data=turntable {shlex.quote(f'data.root={out}')}"
    other_convention = (axes, matrices) != (AXES[0], MATRICES[0])
    if cameras is not None and other_convention:
        raise CompleteSplatError("axes and matrices are of captures that have cameras: leave out cameras=colmap")
    if other_convention:
        root = _converted_capture(Path(folder), axes, matrices, out)
    else:
        root = Path(folder) if cameras is None else _make_capture(Path(folder), frames, max_image_size, out)
    sources = CaptureDataModule(str(root)).open("train")
    for error in sources["train"].refused:
        logger.warning("left out: %s", error)
    for name in sources["train"].names:
        sources["train"].check(name)
        counts = [len(sources[split].read(name).frames) for split in ("train", "test")]
        logger.info("%s: %d images with cameras, of which %d are held out", name, sum(counts), counts[1])
    names = sources["train"].names
    first = root if len(names) == 1 else root / names[0]  # of several captures
    return f"go on with: completesplat fit experiment=capture {shlex.quote(f'data.root={first}')}"


def _converted_capture(source: Path, axes: str, matrices: str, out: Path) -> Path:
    """Write and return `out`/NAME, a copy of a capture with `transform_matrix` as camera-to-world, OpenGL's axes."""
    name = TRANSFORMS[0]
    content = read_json(source / name, allow_nan=True)
    for number, frame in enumerate(field(content, "frames", list)):
        with errors_at(source / name, frame=number):
            matrix = finite_array(field(frame, "transform_matrix", list), (4, 4), "transform_matrix")
            frame["transform_matrix"] = to_camera_to_world(matrix, axes, matrices).tolist()
    capture = out / source.resolve().name
    if capture.exists():
        raise DataError("exists already: choose another out=DIR", str(capture))
    with atomic_folder(capture) as unfinished:
        shutil.copytree(source, unfinished, dirs_exist_ok=True)
        (unfinished / name).write_text(json.dumps(content, indent=1) + "\n")
    return capture


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
            split_video(source, images, frames)
        else:
            copy_photos(source / "images" if (source / "images").is_dir() else source, images)
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
    extraction.max_image_size = max_image_size
    extraction.sift.max_num_features = MOST_FEATURES
    for start in track(range(0, len(names), at_a_time), "features"):
        chunk = names[start : start + at_a_time]
        pycolmap.extract_features(database, images, chunk, extraction_options=extraction)
    lines = [f"{names[a]} {names[b]}\n" for a, b in image_pairs(len(names), sequential)]
    pairing = pycolmap.ImportedPairingOptions()
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
