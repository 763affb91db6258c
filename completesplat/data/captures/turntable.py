"""Import of turntables: a folder of photos that are one turn of an object, or a data set of such folders.

Cameras lie on a circle around the origin, at one elevation, with z up and the turning axis in the image's middle.
"""

import json
import logging
import math
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypedDict

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image, ImageOps
from rich.progress import track
from torch import Tensor

from completesplat.data.captures.capture_set import SPLITS_FILE, read_splits
from completesplat.data.captures.turn_checks import Findings, examine, write_sheet
from completesplat.data.images.crop import Square, cut_square
from completesplat.data.images.files import (
    EIGHT_BIT_MODES,
    FORMATS,
    check_sums,
    decode,
    image_files,
    opened,
    over_grey,
    refused_as_bad,
    save_image,
)
from completesplat.data.images.photograph import without_background
from completesplat.data.validation import BadAnnotation, BadImage, MissingFile, TooFewFrames, at, field, read_json, refused_to
from completesplat.errors import DataError, ImageError
from completesplat.files import writing
from completesplat.geometry.cameras import Cameras, invert_rigid, look_at
from completesplat.settings.schema import Range

logger = logging.getLogger(__name__)

FEWEST_PHOTOS = 8
MOST_SIDE = 1024  # pixels; larger photos are reduced
WHITE = 245  # least value of a white background's pixels, in every channel
FULL = 0.98  # share of the photo; a larger mask fills it
LEAST_FACTOR, LARGEST_FACTOR = 0.8, 1.25  # of the scale that undoes a crop
MARGIN = 1.1  # side of the images, in units of the object's largest side
SUFFIXES = (".jpg", ".png")  # of images and masks
LOW_OVERLAP = 0.85  # of the masks with their visual hull; a turn with less is named
MOST_OF_CHECKS = 128  # pixels of a side


class TurntableSettings(TypedDict):
    """Settings of `import_turntables`.

    Attributes:
        photos_of_a_turn: photos of a full turn, whose file names have their positions as numbers; or a JSON file that
            maps the names of rings to these numbers; None: the photos are a full turn, evenly spaced.
        elevation: of the camera above the object, in degrees.
        fov: field of view across the width of a photo, in degrees.
        direction: 1 if the surface that faces the camera moves left from photo to photo, -1 if it moves right; None:
            found by optical flow.
        height: "ring" scales each photo so that the mask has the ring's median height, and centres it.
        background: "white": what is white from the border on; "remove": what `without_background` removes; None:
            what transparency says.
        splits: file that lists the rings of each split (`read_splits`).
    """

    photos_of_a_turn: Annotated[int, Range(FEWEST_PHOTOS)] | str | None
    elevation: Annotated[float, Range(-85, 85)]
    fov: Annotated[float, Range(1, 120)]
    direction: Literal[1, -1] | None
    height: Literal["ring"] | None
    background: Literal["white", "remove"] | None
    splits: str | None


class Photo(NamedTuple):
    """Photo over white, and the mask of its object, which is not empty."""

    image: Image.Image
    mask: Image.Image

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of the mask in pixels."""
        return self.mask.point(lambda value: 255 * (value > 127)).getbbox() or (0, 0, 0, 0)


@dataclass(frozen=True)
class Turn:
    """Geometry of one ring.

    Attributes:
        positions: of the photos, as in their names, or counted.
        angles: of the photos, in radians.
        side: of the square images, in pixels.
        focal: in pixels.
        distance: of the cameras from the origin, in units of half the object's height.
    """

    positions: list[int]
    angles: Float[np.ndarray, " photo"]
    side: int
    focal: float
    distance: float

    def cameras(self, elevation: float, direction: int) -> Cameras:
        """Return the cameras [photo] in float64.

        If `direction` is 1, each camera is to the right of the one before, so that the surface moves left.
        """
        azimuths, height = torch.from_numpy(direction * self.angles), math.radians(elevation)
        level = math.cos(height) * torch.stack([azimuths.cos(), azimuths.sin()], dim=-1)
        directions = torch.cat([level, torch.full_like(level[:, :1], math.sin(height))], dim=-1)
        up = torch.tensor([0, 0, 1], dtype=level.dtype)
        pose = look_at(self.distance * directions, torch.zeros_like(directions), up)
        middle = self.side / 2
        intrinsics = torch.tensor([[self.focal, 0, middle], [0, self.focal, middle], [0, 0, 1]], dtype=level.dtype)
        return Cameras(pose, intrinsics.expand(len(pose), 3, 3), (self.side, self.side))

    def write(self, folder: Path, elevation: float, direction: int) -> None:
        """Write `transforms.json` (OpenGL's axes) for the images in a folder."""
        poses = invert_rigid(self.cameras(elevation, direction).world_to_camera)
        poses[:, :3, 1:3] *= -1
        frames = [
            {"file_path": f"images/{n:05d}.jpg", "mask_path": f"masks/{n:05d}.png", "transform_matrix": pose}
            for n, pose in zip(self.positions, poses.tolist(), strict=True)
        ]
        lens = {"fl_x": self.focal, "fl_y": self.focal, "cx": self.side / 2, "cy": self.side / 2}
        content = {"camera_model": "PINHOLE", "w": self.side, "h": self.side, **lens, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n")


def import_turntables(folder: Path, out: Path, settings: TurntableSettings) -> None:
    """Write each ring below `folder` as a capture below `out`, all or none, with `splits.json` and `sheet.png`.

    A ring has the name of its path below `folder`, or of `folder` itself if its photos are there. A ring that cannot be
    used is named and left out.

    Raises:
        DataError: there are no photos, no ring can be used, or the list of splits or of turns is wrong.
    """
    folders = _ring_folders(folder, out)
    splits = None if settings["splits"] is None else read_splits(Path(settings["splits"]), list(folders))
    counts = _photos_of_turns(settings["photos_of_a_turn"], list(folders))
    for name in folders:
        if (out / name).exists():
            raise DataError("exists already: choose another out=DIR", str(out / name))
    unfinished = out / ".turntable.unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with writing(out, temporary=unfinished):
            turns, findings = _write_rings(folders, counts, unfinished, settings)
            directions = _directions(findings, settings["direction"])
            for name, turn in turns.items():
                turn.write(unfinished / name, settings["elevation"], directions[name])
            write_sheet(findings, out / "sheet.png")
            if splits is not None:
                left = {split: [name for name in names if name in turns] for split, names in splits.items()}
                (out / SPLITS_FILE).write_text(json.dumps(left, indent=1) + "\n")
            for name in turns:
                (out / name).parent.mkdir(parents=True, exist_ok=True)
                (unfinished / name).rename(out / name)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    _report(findings, directions)


def _ring_folders(root: Path, out: Path) -> dict[str, Path]:
    """Return the folders at and below `root` that have photos, by name; hidden folders and `out` are left out."""
    if not root.is_dir():
        raise MissingFile("no such folder", str(root))
    folders: dict[str, Path] = {}
    for place, below, _ in os.walk(root):
        path = Path(place)
        below[:] = sorted(x for x in below if not x.startswith(".") and (path / x).resolve() != out.resolve())
        if image_files(path):
            folders[path.resolve().name if path == root else path.relative_to(root).as_posix()] = path
    if not folders:
        raise MissingFile("no photos there, nor in its folders", str(root))
    return folders


def _photos_of_turns(given: int | str | None, names: list[str]) -> dict[str, int | None]:
    """Return the number of photos of a full turn for each ring, if known."""
    if not isinstance(given, str):
        return dict.fromkeys(names, given)
    listed = read_json(Path(given))
    with at(given):
        for name in names:
            if (count := field(listed, name, int)) < FEWEST_PHOTOS:
                raise BadAnnotation(f"{name}: {count} photos; a turn needs at least {FEWEST_PHOTOS}")
        return {name: listed[name] for name in names}


def _write_rings(
    folders: Mapping[str, Path], counts: Mapping[str, int | None], out: Path, settings: TurntableSettings
) -> tuple[dict[str, Turn], dict[str, Findings]]:
    """Write the images of all rings that can be used, and name the others."""
    refused: list[DataError] = []
    turns, findings = dict[str, Turn](), dict[str, Findings]()
    for name, folder in track(folders.items(), "turns"):
        with refused_to(refused.append), at(sequence=name):
            turn, photos = read_ring(folder, counts[name], settings)
            images, masks = (torch.stack([_small(photo[part]) for photo in photos]) for part in (0, 1))
            findings[name] = examine(images, masks, turn.angles, turn.cameras(settings["elevation"], 1))
            turns[name] = turn
            for part, kind in enumerate(("images", "masks")):
                (out / name / kind).mkdir(parents=True)
                for position, photo in zip(turn.positions, photos, strict=True):
                    options = {"quality": 95, "subsampling": 0} if part == 0 else {}
                    save_image(photo[part], out / name / kind / f"{position:05d}{SUFFIXES[part]}", **options)
    if not turns:
        raise refused[0]
    for error in refused:
        logger.warning("left out: %s", error)
    return turns, findings


def read_ring(folder: Path, count: int | None, settings: TurntableSettings) -> tuple[Turn, list[Photo]]:
    """Read the photos of one turn, and place its axis in the middle of square images; see `TurntableSettings`.

    Args:
        count: photos of a full turn; None: as many as there are.

    Raises:
        TooFewFrames: there are fewer than 8 photos.
        BadAnnotation: a file name has no number, or two have the same, where `count` is given.
        BadImage: photos have several sizes, or a mask is empty or fills its photo.
    """
    paths = image_files(folder)
    if len(paths) < FEWEST_PHOTOS:
        raise TooFewFrames(f"{len(paths)} photo{'s'[: len(paths) != 1]}; a turn needs at least {FEWEST_PHOTOS}")
    places = dict(enumerate(paths)) if count is None else _numbered(paths, count)
    positions = sorted(places)
    photos = [_read_photo(places[position], settings["background"]) for position in positions]
    size = photos[0].image.size
    for position, photo in zip(positions, photos, strict=True):
        if photo.image.size != size:
            sizes = [f"{width} x {height}" for width, height in (size, photo.image.size)]
            raise BadImage(f"photos of several sizes, {' and '.join(sizes)} pixels", str(places[position]))
    turn, squares = _squared(photos, settings)
    angles = 2 * np.pi * np.array(positions) / (count or len(paths))
    return replace(turn, positions=positions, angles=angles), squares


def _numbered(paths: Sequence[Path], count: int) -> dict[int, Path]:
    """Return photos by the last number in their names, modulo the photos of a turn."""
    places: dict[int, Path] = {}
    for path in paths:
        if not (numbers := re.findall(r"[0-9]+", path.stem)):
            raise BadAnnotation("no number in this name; photos_of_a_turn needs positions in all names", str(path))
        position = int(numbers[-1]) % count
        if position in places:
            raise BadAnnotation(f"the same position in the turn of {count} photos as {places[position].name}", str(path))
        places[position] = path
    return places


def _read_photo(path: Path, background: str | None) -> Photo:
    """Read a photo, upright and at most 1024 pixels wide and high, and find its object."""
    with refused_as_bad(str(path)):
        with opened(path, FORMATS) as stored:
            transparent = stored.has_transparency_data and stored.mode in EIGHT_BIT_MODES
            if transparent:
                check_sums(stored, path)
                image = ImageOps.exif_transpose(stored).convert("RGBA")
        image = image if transparent else decode(path, str(path), "RGB")
        image.thumbnail((MOST_SIDE, MOST_SIDE), Image.Resampling.LANCZOS)
        if background == "remove":
            image = without_background(over_grey(image, 1.0))
        elif background == "white":
            image = over_grey(image, 1.0)
            outside = from_border((np.asarray(image) >= WHITE).all(-1))
            image.putalpha(Image.fromarray(~outside).convert("L"))
        image = image.convert("RGBA")
        photo = Photo(over_grey(image, 1.0), image.getchannel("A"))
        share = np.mean(np.asarray(photo.mask) > 127)
        if share == 0:
            raise ImageError("its mask is empty")
        if share > FULL:
            raise ImageError(f"its mask fills the photo; background={background} finds no background")
    return photo


def from_border(free: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return what can be reached from the border through `free` pixels, by steps along rows and columns."""
    height, width = free.shape
    reached = np.zeros_like(free)
    reached[[0, -1]], reached[:, [0, -1]] = free[[0, -1]], free[:, [0, -1]]
    # Pixels of one run along a row or column, and the obstacle before it, have one number.
    along_rows = np.cumsum(~free, axis=1) + (width + 1) * np.arange(height)[:, None]
    along_columns = np.cumsum(~free, axis=0) + (height + 1) * np.arange(width)
    count = -1
    while count != np.count_nonzero(reached):
        count = np.count_nonzero(reached)
        for runs in (along_rows, along_columns):
            reached = free & (np.bincount(runs.ravel(), reached.ravel())[runs] > 0)
    return reached


def _squared(photos: Sequence[Photo], settings: TurntableSettings) -> tuple[Turn, list[Photo]]:
    """Cut the photos to squares of one size around the axis; the turn has neither positions nor angles yet."""
    boxes = np.array([photo.box for photo in photos], dtype=np.float64)
    height = float(np.median(boxes[:, 3] - boxes[:, 1]))
    if settings["height"] == "ring":
        factors = (height / (boxes[:, 3] - boxes[:, 1])).clip(LEAST_FACTOR, LARGEST_FACTOR)
    else:  # One box around all masks is symmetric about the axis of a full turn.
        boxes[:] = np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])
        factors = np.ones(len(boxes))
    centers, extents = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]).max(1)
    side = math.ceil(MARGIN * (factors * extents).max())
    squares = [
        Photo(*(_cut(part, center, side, factor) for part in photo))
        for photo, center, factor in zip(photos, centers.tolist(), factors.tolist(), strict=True)
    ]
    focal = photos[0].image.width / 2 / math.tan(math.radians(settings["fov"]) / 2)
    return Turn([], np.zeros(0), side, focal, 2 * focal / height), squares


def _cut(image: Image.Image, center: Sequence[float], side: int, factor: float) -> Image.Image:
    """Return a square of `side` pixels around a point, enlarged by `factor`, over white; masks are empty outside."""
    (x, y), half = center, side / factor / 2
    box = (x - half, y - half, x + half, y + half)
    color = image.mode == "RGB"
    resampling = Image.Resampling.BICUBIC if color else Image.Resampling.BILINEAR
    fill = (255, 255, 255) if color else 0
    return image.transform((side, side), Image.Transform.EXTENT, box, resampling, fillcolor=fill)


def _small(image: Image.Image) -> Float[Tensor, "channel size size"]:
    """Return the image, which is square, as the checks see it."""
    size = min(image.width, MOST_OF_CHECKS)
    return cut_square(image, Square(0, 0, image.width), size) / 255


def _directions(findings: Mapping[str, Findings], given: int | None) -> dict[str, int]:
    """Return the direction of each turn: the given one, that of its flow, or, if it has none, that of most turns."""
    most = 1 if sum(found.flow for found in findings.values()) >= 0 else -1
    if given is None and not any(found.flow for found in findings.values()):
        logger.warning("the direction of the flow cannot be told: direction=1 is taken, see --help")
    return {name: given or found.flow or most for name, found in findings.items()}


def _report(findings: Mapping[str, Findings], directions: Mapping[str, int]) -> None:
    """Log a summary of all turns, and the names of those that are odd."""
    flows = {
        word: [name for name, found in findings.items() if found.flow == flow]
        for flow, word in ((1, "left"), (-1, "right"), (0, "unclear"))
    }
    ends, neighbours, half = np.median([found.closing for found in findings.values()], axis=0)
    overlaps = [found.overlap for found in findings.values()]
    parts = [
        f"{len(findings)} turns",
        "flow in the middle: " + ", ".join(f"{word} in {len(names)}" for word, names in flows.items()),
        f"last photo to first: {ends:.1f} of 255 (neighbours {neighbours:.1f}, half a turn {half:.1f})",
        f"overlap with the visual hull: {np.median(overlaps):.3f}",
    ]
    logger.info("%s", "; ".join(parts))
    few = min(("left", "right"), key=lambda word: len(flows[word]))
    if flows[few]:
        logger.warning("flow goes %s, unlike in most: %s", few, ", ".join(flows[few]))
    if flows["unclear"]:
        logger.warning("flow is unclear: %s", ", ".join(flows["unclear"]))
    for name, found in findings.items():
        if found.overlap < LOW_OVERLAP:
            logger.warning("%s: the masks overlap only by %.2f with their visual hull", name, found.overlap)
