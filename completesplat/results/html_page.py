"""A self-contained HTML page: tables, figures, and samples that turn under the mouse."""

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from completesplat import __version__
from completesplat.errors import CompleteSplatError
from completesplat.results.own import mode_tables, own_tables
from completesplat.results.paper_figures import tables as compared
from completesplat.results.runs import CONFIG, MODES, ROWS, SCENE, SCORES, RunTree, find, mapping_or_empty, origin
from completesplat.results.scores import entries
from completesplat.results.tables import BEST, SECOND, Cell, Heading, Table, TableRow

EMPTY = {"img", "meta", "link", "br"}  # elements that have no end tag

WIDEST, MOST_PIXELS = 1600, 50_000_000
"""Width to which wider images are reduced; and pixels of the largest image that is read."""
AS_THEY_ARE, QUALITY = 300_000, 85
"""Bytes up to which a PNG of at most that width is not encoded again; and quality of JPEG."""
SIDE, LONGEST = 256, 60_000
"""Pixels of a frame's longer side; and of the widest strip of frames (JPEG's limit is 65,535)."""


class Html(str):
    """Text that is HTML; any other string is plain text and will be escaped."""


def element(name: str, /, *children: str, **attributes: str | int | bool) -> Html:
    """Return `<name attribute="value">children</name>`; children are elements or plain text.

    Write `class_` for `class`, `aria_label` for `aria-label`, True for an attribute without a value, False for none.
    """
    pairs = [(key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not False]
    opened = "".join(f" {key}" if value is True else f' {key}="{escape(str(value))}"' for key, value in pairs)
    if name in EMPTY:
        return Html(f"<{name}{opened}>")
    return Html(f"<{name}{opened}>{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Join elements and plain text."""
    return Html("".join(child if isinstance(child, Html) else escape(child) for child in children))


def scrollable(name: str, *children: str) -> Html:
    """Return a box that scrolls sideways, also by keyboard; `name` describes it to screen readers."""
    return element("div", *children, class_="scroll", tabindex="0", role="region", aria_label=name)


def folded(summary: str, *children: str, open_: bool = False) -> Html:
    """Return a part that opens when its summary is clicked."""
    return element("details", element("summary", summary), *children, open=open_)


def described(pairs: dict[str, str]) -> Html:
    """Return a list of names and values, without empty values."""
    parts = [element("div", element("dt", name), element("dd", value)) for name, value in pairs.items() if value]
    return element("dl", *parts)


def left_out(text: str) -> Html:
    """Return a line about something that is not shown."""
    return element("p", text, class_="left-out")


class ByteBudget:
    """Bytes that images may still take in one page; data URIs take four characters for three bytes."""

    def __init__(self, megabytes: float) -> None:
        self.left = megabytes * 1e6

    def uri(self, data: bytes, kind: str) -> str | None:
        """Return the data URI of an image, or None if it does not fit any more."""
        uri = f"data:image/{kind};base64,{b64encode(data).decode()}"
        if len(uri) > self.left:
            return None
        self.left -= len(uri)
        return uri


def picture(path: Path, caption: str, budget: ByteBudget) -> Html:
    """Return a figure with its caption, which screen readers read too; or why it is not shown."""
    try:
        data, kind, width, height = _encoded(path)
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        return left_out(f"{caption}: cannot be shown ({' '.join(str(error).split())})")
    if (uri := budget.uri(data, kind)) is None:
        return left_out(f"{caption}: left out, the page is full")
    image = element("img", src=uri, alt=caption, width=width, height=height, loading="lazy")
    return element("figure", scrollable(caption, image), element("figcaption", caption), class_="picture")


def _encoded(path: Path) -> tuple[bytes, str, int, int]:
    """Return bytes, kind, width and height: of the file itself if it is a small PNG, else of a JPEG of it."""
    data = path.read_bytes()
    with Image.open(io.BytesIO(data)) as image:
        width, height = image.size
        if width * height > MOST_PIXELS:
            raise ValueError(f"{width} x {height} pixels are too many")
        image.load()
        if image.format == "PNG" and len(data) <= AS_THEY_ARE and width <= WIDEST:
            return data, "png", width, height
        small = image.convert("RGBA")
    white = Image.new("RGBA", small.size, "white")
    white.alpha_composite(small)
    white.thumbnail((WIDEST, WIDEST * 4))
    return as_jpeg(white.convert("RGB")), "jpeg", *white.size


def as_jpeg(image: Image.Image) -> bytes:
    """Encode an image as a JPEG file."""
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()


def strip(video: Path, count: int) -> tuple[Image.Image, int]:
    """Join at most `count` frames, evenly spread over a video, from left to right; return also their number.

    Raises:
        OSError, RuntimeError, ValueError, IndexError: no readable video (imageio's; it depends on what is wrong).
    """
    import imageio.v2 as imageio

    frames: list[Image.Image] = []
    reader: Any
    with imageio.get_reader(video, format="FFMPEG") as reader:
        total = reader.count_frames()
        wanted = {index * total // count for index in range(count)}
        for index, frame in enumerate(reader):
            if index in wanted:
                image = Image.fromarray(np.asarray(frame))
                image.thumbnail((SIDE, SIDE))
                frames.append(image)
    if not frames:
        raise ValueError("it has no frames")
    strip_frames = [np.asarray(image) for image in frames[: LONGEST // frames[0].width]]
    return Image.fromarray(np.concatenate(strip_frames, axis=1)), len(strip_frames)


def turntable(video: Path, image: str, sample: str, count: int, budget: ByteBudget) -> Html:
    """Return a turning figure of one sample's orbit, a scrolling strip without scripts; or why it is not shown."""
    try:
        joined, frames = strip(video, count)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        return left_out(f"{video.name}: cannot be shown ({' '.join(str(error).split())[:200]})")
    uri, name = budget.uri(as_jpeg(joined), "jpeg"), f"{image}, {sample}"
    if uri is None:
        return left_out(f"{video.name}: left out, the page is full")
    drawn = element("img", src=uri, alt=f"{name}, seen from {frames} directions", style=f"width:{100 * frames}%")
    box = element(
        "div",
        drawn,
        class_="turntable",
        tabindex="0",
        role="slider",
        aria_label=f"{name}: turn it",
        **{"aria_valuemin": "0", "aria_valuemax": str(frames - 1), "aria_valuenow": "0"},
        aria_valuetext="0 degrees",
        data_frames=str(frames),
        style=f"aspect-ratio:{joined.width // frames}/{joined.height}",
    )
    angle = element("span", "0°", class_="angle", aria_hidden="true")
    return element("figure", box, element("figcaption", sample, " ", angle))


MARKED = {BEST: "strong", SECOND: "u"}
PLAIN = (type(None), str, int, float)
PUBLISHED = "paper"  # the source of rows that are not our results

FIGURES = {"": "*.png", "pictures": "step_*.png", "samples": "*.png"}  # subfolders of a run, and the images in each
CAPTIONS = {
    "pictures": ": fixed scenes while training: input, target, render, error, depth, opacity, each layer",
    "samples": ": samples of fixed scenes while training",
}
MOST_CHARACTERS = 20_000  # characters of a config that are shown
NAMED = {"image": "photograph", "mask": "mask", "box": "box", "fov_degrees": "degrees of view", "seed": "seed"}
NAMED |= {"skip_weight": "skip weight", "guidance_weight": "guidance", "sampler": "sampler", "steps": "steps"}
"""Settings of a prediction, and their names on the page."""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""Content policy, by which the browser keeps the page from loading anything, whatever is in it."""
UNFOLDED = 3  # up to this number, all runs are unfolded; beyond it, only runs with a report's figure
HINT = (
    "Move the mouse over a sample, drag a finger across it, or give it the focus and use the arrow keys: all samples "
    "of the photograph turn together. What the photograph does not show is made up, differently in each sample."
)


def comparison(table: Table) -> Html:
    """Return a table with its remarks and notes, folded if it has no result of ours."""
    below = element("ul", *(element("li", line) for line in table.below()), class_="notes")
    whole = element("div", _grid(table), folded("What this table says, and how it was measured", below))
    return folded(f"{table.title}: the published figures, none of ours", whole) if is_published(table) else whole


def is_published(table: Table) -> bool:
    """Return whether a table has the paper's figures only."""
    return all(row.source == PUBLISHED for row in table.rows)


def rows_of(title: str, rows: Sequence[Any]) -> Html:
    """Return a table of records with the same keys, such as those that `completesplat report samplers` writes."""
    records = [row for row in rows if isinstance(row, Mapping)]
    keys = list(dict.fromkeys(str(key) for row in records for key, x in row.items() if isinstance(x, PLAIN)))
    body = [TableRow("", [Cell(_said(row.get(key))) for key in keys]) for row in records]
    return _grid(Table(title, title, [Heading(key.replace("_", " ")) for key in keys], body))


def _grid(table: Table) -> Html:
    body, ruled = [], False
    for row, ruled_below in table.ruled_rows():
        body.append(element("tr", *map(_cell, table.headings, row.cells), class_="rule" if ruled else False))
        ruled = ruled_below
    grid = element("table", element("caption", table.title), element("thead", *_head(table)), element("tbody", *body))
    return scrollable(table.title, grid)


def _head(table: Table) -> list[Html]:
    above = [element("th", name, scope="colgroup", colspan=count, class_="group") for name, count in table.groups()]
    words = [False if heading.figures else "words" for heading in table.headings]
    names = [element("th", h.text, scope="col", class_=kind) for h, kind in zip(table.headings, words, strict=True)]
    return [element("tr", *cells) for cells in (above, names) if cells]


def _cell(heading: Heading, cell: Cell) -> Html:
    text = element(MARKED[cell.mark], cell.text) if cell.mark in MARKED else cell.text
    return element("td", text, class_=False if heading.figures else "words")


def _said(value: Any) -> str:
    return "" if value is None else format(value, ".4g") if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class ShownRun:
    """Folder of a run, its name on the page, its figures by subfolder, and the tables of its scores."""

    path: Path
    name: str
    figures: dict[str, list[Path]]
    tables: list[Table]


def run_section(run: ShownRun, most_pictures: int, budget: ByteBudget, open_: bool) -> Html:
    """Return a section on one run, unfolded at first if `open_`.

    It shows at most `most_pictures` images of each subfolder and says how many others there are.
    """
    parts = [described(origin(run.path, levels=0)), *map(comparison, run.tables)]
    for name in ROWS:
        rows = mapping_or_empty(run.path / name).get("rows")
        if isinstance(rows, list):
            parts.append(rows_of(Path(name).stem, rows))
    for part, paths in run.figures.items():
        # The last images of a run's progress, the first of a report's figures.
        for path in paths[-most_pictures:] if part else paths[:most_pictures]:
            parts.append(picture(path, f"{run.name}, {path.relative_to(run.path)}{CAPTIONS.get(part, '')}", budget))
        parts += _more(len(paths) - most_pictures, f"more in {run.name}/{part}".rstrip("/"))
    if (run.path / CONFIG).is_file():
        text = (run.path / CONFIG).read_text(encoding="utf-8", errors="replace")
        cut = text[:MOST_CHARACTERS] + ("\n... cut here" if len(text) > MOST_CHARACTERS else "")
        parts.append(folded("All settings", element("pre", cut, tabindex="0")))
    return element("details", element("summary", run.name), *parts, class_="run", open=open_)


def _more(count: int, what: str) -> list[Html]:
    return [left_out(f"{count} {what} left out")] if count > 0 else []


def prediction_section(path: Path, name: str, most: Mapping[str, Any], budget: ByteBudget) -> Html:
    """Return a section on one photo: the settings of its samples, each sample turning, and the contact sheet."""
    settings = mapping_or_empty(path / SCENE).get("settings")
    settings = settings if isinstance(settings, dict) else {}
    image = str(settings.get("image") or name)
    videos = sorted(path.glob("orbit_*.mp4"))
    turning = [
        turntable(video, image, video.stem.replace("orbit_", "sample "), most["frames"], budget)
        for video in videos[: most["samples"]]
    ]
    values = [f"{label} {_said(settings[key])}" for key, label in NAMED.items() if settings.get(key) is not None]
    parts = [element("h3", name), described({"settings": ", ".join(values), **origin(path)})]
    if turning:
        parts.append(element("div", *turning, class_="samples"))
    parts += _more(len(videos) - most["samples"], "more samples")
    if (path / "sheet.png").is_file():
        sheet = picture(path / "sheet.png", f"{image}: input, and views around each sample", budget)
        parts.append(folded("Contact sheet", sheet, open_=not turning))
    return element("section", *parts, aria_label=f"Prediction {name}")


def page(folder: Path, out: Path, most: Mapping[str, Any], made: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return the page on everything below a folder except `out`, and a line for each unusable file of results.

    Args:
        most: limits: `frames` of a turn, `samples` of a photo, `predictions`, `runs`, `pictures` of a run's subfolder,
            and `megabytes` of all images.
        made: command, date and commit of the page.

    Raises:
        CompleteSplatError: there is no such folder, or it has nothing to show.
    """
    tree, budget = find(folder), ByteBudget(most["megabytes"])
    all_runs, predicted = _shown_runs(tree, out), [path for path in tree.predictions if path.resolve() != out.resolve()]
    if not all_runs and not predicted:
        raise CompleteSplatError(
            f"runs={folder}: nothing to show in it or below it; `completesplat fit`, `test`, `predict` and `report` "
            "write what a page is made of"
        )
    listed = predicted[: most["predictions"]]
    predictions = [prediction_section(path, _name(path, folder), most, budget) for path in listed]
    few = len(all_runs) <= UNFOLDED
    runs = [run_section(run, most["pictures"], budget, few or "" in run.figures) for run in all_runs[: most["runs"]]]
    predictions += _more(len(predicted) - len(listed), "more predictions")
    runs += _more(len(all_runs) - len(runs), "more runs")
    tables = compared(tree) if tree.scores or tree.modes or tree.warnings else []
    sections = {
        "Predictions": [element("p", HINT), *predictions] if predictions else [],
        "Tables": [comparison(table) for table in sorted(tables, key=is_published)],
        "Runs": runs,
        "Left out": [element("ul", *(element("li", line) for line in tree.warnings))] if tree.warnings else [],
    }
    title = f"completesplat: {folder.resolve().name}"
    return _document(title, {name: parts for name, parts in sections.items() if parts}, made), tree.warnings


def _name(path: Path, root: Path) -> str:
    return root.resolve().name if path == root else path.relative_to(root).as_posix()


def _shown_runs(tree: RunTree, out: Path) -> list[ShownRun]:
    """Return the runs with figures, scores or rows."""
    tables: dict[Path, list[Table]] = {run.folder: own_tables(entries([run])) for run in tree.scores}
    for run in tree.modes:
        tables[run.folder] = [*tables.get(run.folder, []), *mode_tables([run])]
    selected = []
    for path in tree.runs:
        by_part = {part: sorted((path / part).glob(pattern)) for part, pattern in FIGURES.items()}
        figures = {part: paths for part, paths in by_part.items() if paths}
        shows = figures or any((path / name).is_file() for name in (SCORES, MODES, *ROWS))
        if shows and path.resolve() != out.resolve():
            selected.append(ShownRun(path, _name(path, tree.folder), figures, tables.get(path, [])))
    return selected


def _document(title: str, sections: Mapping[str, list[Html]], made: Mapping[str, str]) -> str:
    style, script = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    identities = {name: name.lower().replace(" ", "-") for name in sections}
    meta: list[dict[str, Any]] = [{"charset": "utf-8"}, {"http_equiv": "Content-Security-Policy", "content": POLICY}]
    meta.append({"name": "viewport", "content": "width=device-width, initial-scale=1"})
    heads = [*(element("meta", **attributes) for attributes in meta), element("title", title)]
    head = element("head", *heads, element("style", Html(style)))
    links = [element("li", element("a", name, href=f"#{identity}")) for name, identity in identities.items()]
    top = element("header", element("h1", title), element("nav", element("ul", *links), aria_label="Sections"))
    body = [
        element("section", element("h2", name, id=identities[name]), *parts, aria_labelledby=identities[name])
        for name, parts in sections.items()
    ]
    facts = [f"{key} {value}" for key, value in made.items() if value]
    footer = element("footer", f"Made by completesplat {__version__}: {'; '.join(facts)}")
    whole = element("body", top, element("main", *body), footer, element("script", Html(script)))
    return joined(Html("<!DOCTYPE html>\n"), element("html", head, whole, lang="en"), "\n")
