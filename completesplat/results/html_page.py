"""A self-contained HTML page: tables, figures, and samples that turn under the mouse.

`page.html` is its template; this module collects what the template shows.
"""

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypedDict

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from completesplat import __version__
from completesplat.errors import CompleteSplatError
from completesplat.results.measured import entries, mode_tables, score_tables
from completesplat.results.paper_figures import tables as compared
from completesplat.results.runs import CONFIG, MODES, ROWS, SCENE, SCORES, find, origin, read_mapping
from completesplat.results.tables import Table, records_table
from completesplat.settings.schema import Positive, Range

WIDEST, MOST_PIXELS = 1600, 50_000_000
"""Width to which wider images are reduced; and pixels of the largest image that is read."""
UNCHANGED, QUALITY = 300_000, 85
"""Bytes up to which a PNG of at most that width is not encoded again; and quality of JPEG."""
SIDE, LONGEST = 256, 60_000
"""Pixels of a frame's longer side; and of the widest strip of frames (JPEG's limit is 65,535)."""
IMAGES = {"": "*.png", "images": "step_*.png", "samples": "*.png"}  # subfolders of a run, and the images in each
CAPTIONS = {
    "images": ": fixed scenes while training: input, target, render, error, depth, opacity, each layer",
    "samples": ": samples of fixed scenes while training",
}
MOST_CHARACTERS = 20_000  # characters of a config that are shown
NAMED = {"image": "photograph", "mask": "mask", "box": "box", "fov_degrees": "degrees of view", "seed": "seed"}
NAMED |= {"skip_weight": "skip weight", "guidance_weight": "guidance", "color_fits": "colour fits"}
NAMED |= {"sampler": "sampler", "steps": "steps"}
"""Settings of a prediction, and their names on the page."""
UNFOLDED = 3  # up to this number, all runs are unfolded; beyond it, only runs with a report's figure


class Limits(TypedDict):
    """Limits on the contents of a page; `conf/report_task/html.yaml` explains each."""

    frames: Positive
    samples: Positive
    predictions: Positive
    runs: Positive
    images: Positive
    megabytes: Annotated[float, Range(1)]


@dataclass(frozen=True)
class Embedded:
    """Image in the page, or `problem`: the line that stands in its place. A turning sample has several frames."""

    caption: str
    problem: str = ""
    uri: str = ""
    width: int = 0
    height: int = 0
    frames: int = 1


@dataclass(frozen=True)
class Section:
    """Part of the page on one run or one prediction; `turning` are a prediction's samples, `sheet` its last image."""

    name: str
    facts: Mapping[str, str]
    images: list[Embedded] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    turning: list[Embedded] = field(default_factory=list)
    sheet: Embedded | None = None
    config: str = ""
    open: bool = False


class ImageEncoder:
    """Encoder of images as data URIs, until the page is full; a data URI takes four characters for three bytes."""

    def __init__(self, megabytes: float) -> None:
        self.left = megabytes * 1e6

    def embed(self, path: Path, caption: str) -> Embedded:
        """Embed an image, or state why it is not shown."""
        try:
            data, kind, width, height = _encoded(path)
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            return Embedded(caption, f"{caption}: cannot be shown ({' '.join(str(error).split())})")
        return self._fitting(caption, data, kind, width, height)

    def turntable(self, video: Path, caption: str, count: int) -> Embedded:
        """Embed the frames of a video side by side, or state why they are not shown."""
        try:
            strip, frames = frame_strip(video, count)
        except (OSError, RuntimeError, ValueError, IndexError) as error:
            return Embedded(caption, f"{video.name}: cannot be shown ({' '.join(str(error).split())[:200]})")
        return self._fitting(caption, _jpeg(strip), "jpeg", strip.width // frames, strip.height, frames)

    def _fitting(self, caption: str, data: bytes, kind: str, width: int, height: int, frames: int = 1) -> Embedded:
        uri = f"data:image/{kind};base64,{b64encode(data).decode()}"
        if len(uri) > self.left:
            return Embedded(caption, f"{caption}: left out, the page is full")
        self.left -= len(uri)
        return Embedded(caption, "", uri, width, height, frames)


def _encoded(path: Path) -> tuple[bytes, str, int, int]:
    """Return bytes, kind, width and height: of the file itself if it is a small PNG, else of a JPEG of it."""
    data = path.read_bytes()
    with Image.open(io.BytesIO(data)) as image:
        width, height = image.size
        if width * height > MOST_PIXELS:
            raise ValueError(f"{width} x {height} pixels are too many")
        image.load()
        if image.format == "PNG" and len(data) <= UNCHANGED and width <= WIDEST:
            return data, "png", width, height
        small = image.convert("RGBA")
    white = Image.new("RGBA", small.size, "white")
    white.alpha_composite(small)
    white.thumbnail((WIDEST, WIDEST * 4))
    return _jpeg(white.convert("RGB")), "jpeg", *white.size


def _jpeg(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()


def frame_strip(video: Path, count: int) -> tuple[Image.Image, int]:
    """Join at most `count` frames, evenly spread over a video, from left to right; return also their number.

    Raises:
        OSError, RuntimeError, ValueError, IndexError: no readable video (imageio's; it depends on what is wrong).
    """
    import imageio.v2 as imageio

    frames: list[Image.Image] = []
    with imageio.get_reader(video, format="FFMPEG") as reader:
        total = reader.count_frames()  # type: ignore[attr-defined]
        chosen = {index * total // count for index in range(count)}
        for index, frame in enumerate(reader.iter_data()):  # type: ignore[attr-defined]
            if index in chosen:
                image = Image.fromarray(np.asarray(frame))
                image.thumbnail((SIDE, SIDE))
                frames.append(image)
    if not frames:
        raise ValueError("it has no frames")
    selected = [np.asarray(image) for image in frames[: LONGEST // frames[0].width]]
    return Image.fromarray(np.concatenate(selected, axis=1)), len(selected)


def _more(count: int, what: str) -> list[Embedded]:
    return [Embedded("", f"{count} {what} left out")] if count > 0 else []


def _shows(path: Path) -> bool:
    """Return whether a run has images, scores or rows."""
    images = any(any((path / part).glob(pattern)) for part, pattern in IMAGES.items())
    return images or any((path / file).is_file() for file in (SCORES, MODES, *ROWS))


def _run_section(path: Path, name: str, tables: Sequence[Table], most: int, images: ImageEncoder) -> Section:
    """Return a section with at most `most` images of each subfolder."""
    embedded, tables = list[Embedded](), [*tables]
    for file in ROWS:
        rows = read_mapping(path / file).get("rows")
        tables += [records_table(Path(file).stem, rows)] if isinstance(rows, list) else []
    for part, pattern in IMAGES.items():
        paths = sorted((path / part).glob(pattern))
        # The last images of a run's progress, the first of a report's figures.
        for image in paths[-most:] if part else paths[:most]:
            caption = f"{name}, {image.relative_to(path)}{CAPTIONS.get(part, '')}"
            embedded.append(images.embed(image, caption))
        embedded += _more(len(paths) - most, f"more in {name}/{part}".rstrip("/"))
    config = path / CONFIG
    text = config.read_text(encoding="utf-8", errors="replace") if config.is_file() else ""
    cut = text[:MOST_CHARACTERS] + ("\n... cut here" if len(text) > MOST_CHARACTERS else "")
    return Section(name, origin(path, levels=0), embedded, tables, config=cut, open=any(path.glob(IMAGES[""])))


def _prediction_section(path: Path, name: str, most: Limits, images: ImageEncoder) -> Section:
    settings = read_mapping(path / SCENE).get("settings")
    settings = settings if isinstance(settings, dict) else {}
    photo, videos = str(settings.get("image") or name), sorted(path.glob("orbit_*.mp4"))
    captions = {video: f"{photo}, {video.stem.replace('orbit_', 'sample ')}" for video in videos[: most["samples"]]}
    turning = [images.turntable(video, caption, most["frames"]) for video, caption in captions.items()]
    values = {label: settings[key] for key, label in NAMED.items() if settings.get(key) is not None}
    texts = [f"{label} {value:{'.4g' if isinstance(value, float) else ''}}" for label, value in values.items()]
    more, sheet = _more(len(videos) - most["samples"], "more samples"), path / "sheet.png"
    embedded = images.embed(sheet, f"{photo}: input, and views around each sample") if sheet.is_file() else None
    facts = {"settings": ", ".join(texts), **origin(path)}
    return Section(name, facts, more, turning=turning, sheet=embedded)


def page(folder: Path, out: Path, most: Limits, made: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return the page on everything below a folder except `out`, and a line for each unusable file of results.

    Args:
        made: command, date and commit of the page.

    Raises:
        CompleteSplatError: there is no such folder, or it has nothing to show.
    """
    tree, images, out = find(folder), ImageEncoder(most["megabytes"]), out.resolve()
    predicted = [path for path in tree.predictions if path.resolve() != out]
    tested = [path for path in tree.runs if _shows(path) and path.resolve() != out]
    if not tested and not predicted:
        raise CompleteSplatError(
            f"runs={folder}: nothing to show in it or below it; `completesplat fit`, `test`, `predict` and `report` "
            "write what a page is made of"
        )
    tables: dict[Path, list[Table]] = {run.folder: score_tables(entries([run])) for run in tree.scores}
    for run in tree.modes:
        tables[run.folder] = [*tables.get(run.folder, []), *mode_tables([run])]
    listed, selected = predicted[: most["predictions"]], tested[: most["runs"]]
    predictions = [_prediction_section(path, _name(path, folder), most, images) for path in listed]
    runs = [_run_section(path, _name(path, folder), tables.get(path, []), most["images"], images) for path in selected]
    here = Path(__file__).parent
    environment = Environment(loader=FileSystemLoader(here), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    text = environment.get_template("page.html").render(
        title=f"completesplat: {folder.resolve().name}",
        style=(here / "page.css").read_text(encoding="utf-8"),
        script=(here / "page.js").read_text(encoding="utf-8"),
        predictions=predictions,
        more_predictions=len(predicted) - len(listed),
        tables=compared(tree) if tree.scores or tree.modes or tree.warnings else [],
        runs=runs,
        more_runs=len(tested) - len(selected),
        unfolded=len(tested) <= UNFOLDED,
        warnings=tree.warnings,
        made="; ".join(f"{key} {value}" for key, value in made.items() if value),
        version=__version__,
    )
    return text.lstrip(), tree.warnings


def _name(path: Path, root: Path) -> str:
    return root.resolve().name if path == root else path.relative_to(root).as_posix()
