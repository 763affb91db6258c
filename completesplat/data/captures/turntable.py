"""Import of turntables: a folder of photos that are one turn of an object, or a data set of such folders.

Cameras lie on a circle around the origin at one elevation, with z up and the turning axis in the images' middle. The
object is 2 units high.
"""

import json
import logging
import math
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypedDict

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image, ImageOps
from rich.progress import track

from completesplat.data.captures.capture_set import SPLITS_FILE, read_splits
from completesplat.data.captures.turn_checks import Turn, examine, write_sheet
from completesplat.data.validation import field, read_json
from completesplat.errors import BadAnnotation, BadImage, DataError, ImageError, MissingFile, TooFewFrames, refused_to
from completesplat.files import writing
from completesplat.geometry.cameras import Cameras, invert_rigid, look_at, mirror
from completesplat.photo import files, saving
from completesplat.photo.background import without_background
from completesplat.photo.crop import Square, cut_square
from completesplat.quantities import Range
from completesplat.wording import counted

logger = logging.getLogger(__name__)

FEWEST_PHOTOS = 8
MOST_SIDE = 512  # pixels; larger photos are reduced
SHEET = "sheet.png"
WHITE = 245  # least value of a white background's pixels, in every channel
FULL = 0.98  # a mask that covers more than this share of the photo is refused
LEAST_FACTOR = 0.8
LARGEST_FACTOR = 1.25  # bounds of the scale that undoes a crop
MARGIN = 1.1  # side of the images, in units of the object's largest side
LOW_OVERLAP = 0.85  # of the masks with their visual hull; a turn with less is named

Photo = tuple[Image.Image, Image.Image]
"""RGB image over white, and mask of the object."""


class TurntableSettings(TypedDict):
    """Settings of `import_turntables`, which `conf/data_task/import.yaml` explains."""

    photos_of_a_turn: Annotated[int, Range(FEWEST_PHOTOS)] | str | None
    elevation: Annotated[float, Range(-85, 85)]
    fov: Annotated[float, Range(1, 120)]
    direction: Literal[1, -1] | None
    height: Literal["ring"] | None
    background: Literal["white", "remove"] | None
    splits: str | None


def import_turntables(folder: Path, out: Path, settings: TurntableSettings) -> None:
    """Write each usable turn below `folder` as a capture below `out`, with `splits.json` and `sheet.png`.

    A turn has the name of its path below `folder`, or of `folder` itself if its photos are there. A turn that cannot be
    used is named and left out.

    Raises:
        DataError: there are no photos, no turn can be used, or the list of splits or of turns is wrong.
    """
    folders = _folders_of_photos(folder)
    splits = {} if settings["splits"] is None else read_splits(Path(settings["splits"]), list(folders))
    for name in (*folders, SHEET):
        if (out / name).exists():
            raise DataError("exists already: choose another out=DIR", str(out / name))
    unfinished = out / ".turntable.unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with writing(out, unfinished):
            turns = _write_turns(folders, unfinished, settings)
            _write_cameras(turns, unfinished, settings["direction"])
            write_sheet(turns, unfinished / SHEET)
            if splits:
                usable = {split: [name for name in names if name in turns] for split, names in splits.items()}
                (unfinished / SPLITS_FILE).write_text(json.dumps(usable, indent=1) + "\n")
            written = list(turns)
            if splits:
                written.append(SPLITS_FILE)
            written.append(SHEET)
            for name in written:
                (out / name).parent.mkdir(parents=True, exist_ok=True)
                (unfinished / name).rename(out / name)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _write_turns(folders: Mapping[str, Path], out: Path, settings: TurntableSettings) -> dict[str, Turn]:
    """Write images and masks of all turns that can be used, return their findings, and name those that cannot."""
    count = settings["photos_of_a_turn"]
    counts = read_json(Path(count)) if isinstance(count, str) else dict.fromkeys(folders, count)
    turns = dict[str, Turn]()
    refused = list[DataError]()
    for name, photos in track(folders.items(), "turns"):
        with refused_to(refused.append, sequence=name):
            known = None if count is None else field(counts, name, int)
            if known is not None and known < FEWEST_PHOTOS:
                raise BadAnnotation(f"photos_of_a_turn: {known}; a turn needs at least {FEWEST_PHOTOS}")
            turns[name] = _write_turn(photos, known, out / name, settings)
    if not turns:
        raise refused[0]
    for error in refused:
        logger.warning("left out: %s", error)
    return turns


def _write_cameras(turns: Mapping[str, Turn], folder: Path, direction: int | None) -> None:
    """Report on the turns, and write the cameras of each. An unclear turn goes as most do."""
    most = 1 if _report(turns) >= 0 else -1
    for name, turn in turns.items():
        moves_right = (direction or turn.flow or most) == -1
        _write_transforms(folder / name, mirror(turn.cameras) if moves_right else turn.cameras)


def _folders_of_photos(root: Path) -> dict[str, Path]:
    """Return, by name, the outermost folders at or below `root` that hold photos."""
    if not root.is_dir():
        raise MissingFile("no such folder", str(root))
    folders: dict[str, Path] = {}
    for path in (root, *sorted(root.rglob("*/"))):
        if files.image_files(path, files.photo_formats()) and not {*path.parents} & {*folders.values()}:
            folders[path.relative_to(root).as_posix() if path != root else root.resolve().name] = path
    if not folders:
        raise MissingFile("no photos there, nor in its folders", str(root))
    return folders


def _write_turn(folder: Path, count: int | None, out: Path, settings: TurntableSettings) -> Turn:
    """Write images and masks of one turn, squares with the axis in the middle, and return its cameras and findings.

    Args:
        count: photos of a full turn; None: as many as there are.

    Raises:
        TooFewFrames: there are fewer than 8 photos.
        BadAnnotation: a file name has no number, or two have the same, where `count` is given.
        BadImage: photos have several sizes, or a mask is empty or fills its photo.
        DataError: the turn does not close.
    """
    paths = files.image_files(folder, files.photo_formats())
    if len(paths) < FEWEST_PHOTOS:
        raise TooFewFrames(f"{counted(len(paths), 'photo')}; a turn needs at least {FEWEST_PHOTOS}")
    places = dict(enumerate(paths)) if count is None else _numbered(paths, count)
    positions = sorted(places)
    photos = [_read_photo(places[position], settings["background"]) for position in positions]
    sizes = sorted({image.size for image, _ in photos})
    if len(sizes) > 1:
        raise BadImage("photos of several sizes: " + ", ".join(f"{width} x {height}" for width, height in sizes))
    focal = sizes[0][0] / 2 / math.tan(math.radians(settings["fov"]) / 2)
    photos, height = _squared(photos, settings["height"])
    angles = 2 * np.pi * np.array(positions) / (count or len(paths))
    cameras = _on_circle(angles, settings["elevation"], 2 * focal / height, focal, photos[0][0].width)
    whole = Square(0, 0, photos[0][0].width)
    size = min(128, photos[0][0].width)
    images = torch.stack([cut_square(image, whole, size) / 255 for image, _ in photos])
    masks = torch.stack([cut_square(mask, whole, size) / 255 for _, mask in photos])
    turn = examine(images, masks, angles, cameras)
    for kind in ("images", "masks"):
        (out / kind).mkdir(parents=True)
    for position, (image, mask) in zip(positions, photos, strict=True):
        saving.save_image(image, out / f"images/{position:05d}.jpg", quality=95, subsampling=0)
        saving.save_image(mask, out / f"masks/{position:05d}.png")
    return turn


def _on_circle(
    angles: Float[np.ndarray, " photo"], elevation: float, distance: float, focal: float, side: int
) -> Cameras:
    """Return cameras [photo] in float64 whose azimuths are the angles, each to the right of the one before."""
    azimuths = torch.from_numpy(angles)
    height = math.radians(elevation)
    level = math.cos(height) * torch.stack([azimuths.cos(), azimuths.sin()], dim=-1)
    eyes = distance * torch.cat([level, torch.full_like(level[:, :1], math.sin(height))], dim=-1)
    poses = look_at(eyes, torch.zeros_like(eyes), eyes.new_tensor([0, 0, 1]))
    intrinsics = eyes.new_tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    return Cameras(poses, intrinsics.expand(len(poses), 3, 3), (side, side))


def _numbered(paths: Sequence[Path], count: int) -> dict[int, Path]:
    """Return photos by the last number in their names, modulo the photos of a turn."""
    places: dict[int, Path] = {}
    for path in paths:
        numbers = re.findall(r"[0-9]+", path.stem)
        if not numbers:
            raise BadAnnotation("no number in this name, but photos_of_a_turn needs positions", str(path))
        first = places.setdefault(int(numbers[-1]) % count, path)
        if first != path:
            raise BadAnnotation(f"the same position in the turn of {count} photos as {first.name}", str(path))
    return places


def _read_photo(path: Path, background: str | None) -> Photo:
    """Read a photo, upright and at most 512 pixels wide and high, and find its object."""
    with files.refused_as_bad(str(path)):
        with files.open_image(path, files.photo_formats()) as stored:
            if stored.mode not in files.EIGHT_BIT_MODES:
                raise ImageError(f"colour mode {stored.mode} is not supported")
            files.check_sums(stored, path)
            image = files.in_srgb(ImageOps.exif_transpose(stored)).convert("RGBA")
        image.thumbnail((MOST_SIDE, MOST_SIDE), Image.Resampling.LANCZOS)
        if background is not None:
            image = files.over_grey(image, 1.0)
            image = without_background(image) if background == "remove" else _without_white(image)
        mask = image.getchannel("A")
        share = np.mean(np.asarray(mask) > 127)
        setting = "null" if background is None else background
        if share == 0:
            raise ImageError(f"background={setting}: its mask is empty")
        if share > FULL:
            advice = "another background (white, remove) may find the object"
            raise ImageError(f"background={setting}: its mask fills the photo; {advice}")
        return files.over_grey(image, 1.0), mask


def _without_white(image: Image.Image) -> Image.Image:
    """Make white pixels transparent that can be reached from the border through white ones."""
    white = np.pad((np.asarray(image) >= WHITE).all(-1), 1, constant_values=True)
    before = np.zeros_like(white)
    reached = np.zeros_like(white)
    reached[0] = True
    while (reached != before).any():  # Pillow's own flood fill is five times as slow
        before = reached
        reached = _along_rows(_along_rows(reached, white).T, white.T).T
    image.putalpha(Image.fromarray(~reached[1:-1, 1:-1]).convert("L"))
    return image


def _along_rows(
    reached: Bool[np.ndarray, "height width"], white: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Extend what is reached over the white pixels beside it in its rows."""
    rows = (1 + white.shape[1]) * np.arange(len(white))[:, None]
    runs = rows + np.cumsum(~white, axis=1)  # a number for each run of white pixels
    touched = np.bincount(runs.ravel(), reached.ravel()) > 0
    return np.where(white, touched[runs], False)


def _squared(photos: Sequence[Photo], height: str | None) -> tuple[list[Photo], float]:
    """Cut the photos to squares of one size around the axis, and return also the object's height in pixels."""
    masks = [mask.point(lambda value: 255 * (value > 127)) for _, mask in photos]
    boxes = np.array([mask.getbbox() for mask in masks], dtype=np.float64)
    heights = boxes[:, 3] - boxes[:, 1]
    factors = np.ones(len(boxes))
    if height == "ring":
        factors = (np.median(heights) / heights).clip(LEAST_FACTOR, LARGEST_FACTOR)
    else:  # Over a full turn, the box around all masks is centred on the axis.
        boxes[:] = np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])
    sizes = boxes[:, 2:] - boxes[:, :2]
    centers = (boxes[:, :2] + boxes[:, 2:]) / 2
    side = math.ceil(MARGIN * (factors * sizes.max(1)).max())
    squares = []
    for (image, mask), center, factor in zip(photos, centers, factors, strict=True):
        box = tuple(np.concatenate([center - side / factor / 2, center + side / factor / 2]).tolist())
        cut = ((side, side), Image.Transform.EXTENT, box)
        color = image.transform(*cut, Image.Resampling.BICUBIC, fillcolor="white")
        squares.append((color, mask.transform(*cut, Image.Resampling.BILINEAR)))
    return squares, float(np.median(heights))


def _write_transforms(folder: Path, cameras: Cameras) -> None:
    """Write `transforms.json`, with OpenGL's axes, for the images in a folder."""
    poses = invert_rigid(cameras.world_to_camera)
    poses[:, :3, 1:3] *= -1
    names = [path.stem for path in sorted((folder / "images").iterdir())]
    frames = [
        {"file_path": f"images/{name}.jpg", "mask_path": f"masks/{name}.png", "transform_matrix": pose}
        for name, pose in zip(names, poses.tolist(), strict=True)
    ]
    focal = float(cameras.intrinsics[0, 0, 0])
    height, width = cameras.image_size
    content = {
        "camera_model": "PINHOLE",
        "fl_x": focal,
        "fl_y": focal,
        "w": width,
        "h": height,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n")


def _report(turns: Mapping[str, Turn]) -> int:
    """Log a summary of all turns and the names of odd ones, and return how many more turns flow left than right."""
    left = [name for name, turn in turns.items() if turn.flow == 1]
    right = [name for name, turn in turns.items() if turn.flow == -1]
    unclear = [name for name, turn in turns.items() if turn.flow == 0]
    ends, neighbours, opposite = np.median([turn.differences for turn in turns.values()], axis=0)
    overlap = np.median([turn.overlap for turn in turns.values()])
    logger.info(
        f"{len(turns)} turns; flow in the middle goes left in {len(left)}, right in {len(right)}, is unclear in "
        f"{len(unclear)}; last and first photo differ by {ends:.1f} of 255, neighbours by {neighbours:.1f}, opposite "
        f"ones by {opposite:.1f}; the masks overlap by {overlap:.3f} with their visual hull (medians)"
    )
    low = [name for name, turn in turns.items() if turn.overlap < LOW_OVERLAP]
    if len(left) < len(right):
        _warn_of("flow goes left, unlike in most", left)
    else:
        _warn_of("flow goes right, unlike in most", right)
    _warn_of("flow is unclear, the direction of most is taken", unclear)
    _warn_of(f"the masks overlap by less than {LOW_OVERLAP} with their visual hull", low)
    return len(left) - len(right)


def _warn_of(fault: str, turns: Sequence[str]) -> None:
    if turns:
        logger.warning("%s: %s", fault, ", ".join(turns))
