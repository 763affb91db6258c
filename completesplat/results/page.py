"""One page of HTML that needs nothing else: tables, figures, and samples that turn under the mouse."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from completesplat import __version__
from completesplat.errors import CompleteSplatError
from completesplat.results.own import mode_tables, own_tables
from completesplat.results.page_parts import (
    Html,
    Room,
    described,
    element,
    folded,
    joined,
    picture,
    scrollable,
    turntable,
)
from completesplat.results.published import tables as compared
from completesplat.results.rows import entries
from completesplat.results.runs import CONFIG, ROWS, SCENE, Folder, find, find_folders, origin, read_object
from completesplat.results.tables import BEST, SECOND, Cell, Heading, Table

MARKED = {BEST: "strong", SECOND: "u"}
PUBLISHED = "paper"
"""The source of rows that are no results of ours."""


def comparison(table: Table) -> Html:
    """A table with what stands below it; without a result of ours it is folded."""
    if is_published(table):
        return folded(f"{table.title}: the published figures, none of ours", _whole(table))
    return _whole(table)


def is_published(table: Table) -> bool:
    """Whether it has the paper's figures only."""
    return all(row.source == PUBLISHED for row in table.rows)


def rows_of(title: str, rows: Sequence[Any]) -> Html:
    """Records with the same keys, such as `completesplat report samplers` writes."""
    records = [row for row in rows if isinstance(row, Mapping)]
    keys = list(dict.fromkeys(str(key) for row in records for key, value in row.items() if _is_plain(value)))
    head = element("tr", *(element("th", key.replace("_", " "), scope="col") for key in keys))
    body = [element("tr", *(element("td", _said(row.get(key))) for key in keys)) for row in records]
    shown = element("table", element("caption", title), element("thead", head), element("tbody", *body))
    return scrollable(title, shown)


def _whole(table: Table) -> Html:
    sources = [row.source for row in [*table.rows[:1], *table.rows]][: len(table.rows)]  # of the row above
    body = [
        element("tr", *map(_cell, table.headings, row.cells), class_="rule" if source != row.source else False)
        for source, row in zip(sources, table.rows, strict=True)
    ]
    shown = element("table", element("caption", table.title), element("thead", *_head(table)), element("tbody", *body))
    below = element("ul", *(element("li", line) for line in table.below()), class_="notes")
    return element(
        "div", scrollable(table.title, shown), folded("What this table says, and how it was measured", below)
    )


def _head(table: Table) -> list[Html]:
    names = [element("th", heading.text, scope="col", class_=_kind(heading)) for heading in table.headings]
    if not any(heading.group for heading in table.headings):
        return [element("tr", *names)]
    groups = [(name, len(list(members))) for name, members in groupby(heading.group for heading in table.headings)]
    above = [element("th", name, scope="colgroup", colspan=count, class_="group") for name, count in groups]
    return [element("tr", *above), element("tr", *names)]


def _cell(heading: Heading, cell: Cell) -> Html:
    text = element(MARKED[cell.mark], cell.text) if cell.mark in MARKED else cell.text
    return element("td", text, class_=_kind(heading))


def _kind(heading: Heading) -> str | bool:
    return False if heading.figures else "words"


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, str | int | float)


def _said(value: Any) -> str:
    return "" if value is None else format(value, ".4g") if isinstance(value, float) else str(value)


CAPTIONS = {
    "pictures": "fixed scenes while training: input, target, render, error, depth, opacity, each layer",
    "samples": "samples of fixed scenes while training",
}
LONGEST = 20_000
"""Characters of a configuration."""


def run(found: Folder, tables: Mapping[str, list[Table]], most_pictures: int, room: Room, open_: bool) -> Html:
    """A section of one run, folded unless `open_`.

    Args:
        found: the folder.
        tables: its scores.
        most_pictures: that are shown of each subfolder, the latest; how many others there are is said.
        room: that is left in the page.
        open_: whether it is unfolded at first.
    """
    parts = [described(origin(found.path, levels=0)), *(comparison(table) for table in tables.get(found.name, []))]
    for name in ROWS:
        rows = read_object(found.path / name).get("rows")
        if isinstance(rows, list):
            parts.append(rows_of(Path(name).stem, rows))
    for part, paths in found.figures.items():
        parts += _figures(found, part, paths, most_pictures, room)
    config = found.path / CONFIG
    if config.is_file():
        text = config.read_text(encoding="utf-8", errors="replace")
        cut = text[:LONGEST] + ("\n... cut here" if len(text) > LONGEST else "")
        parts.append(folded("All settings", element("pre", cut, tabindex="0")))
    return element("details", element("summary", found.name), *parts, class_="run", open=open_)


def _figures(found: Folder, part: str, paths: list[Path], most: int, room: Room) -> list[Html]:
    shown = paths[-most:] if part else paths[:most]  # of a run's progress the end, of a report's figures the first
    said = f": {CAPTIONS[part]}" if part else ""
    drawn = [picture(path, f"{found.name}, {path.relative_to(found.path)}{said}", room) for path in shown]
    if len(paths) > len(shown):
        left = f"{len(paths) - len(shown)} more in {found.name}/{part}".rstrip("/")
        drawn.append(element("p", f"{left} left out", class_="left-out"))
    return drawn


NAMED = {
    "image": "photograph",
    "mask": "mask",
    "box": "box",
    "fov_degrees": "degrees of view",
    "seed": "seed",
    "skip_weight": "skip weight",
    "guidance_weight": "guidance",
    "sampler": "sampler",
    "steps": "steps",
}
"""Settings of a prediction, and what they are called here."""


def prediction(found: Folder, frames: int, most_samples: int, room: Room) -> Html:
    """A section of one photograph: how its samples were made, each of them turning, and the sheet.

    Args:
        found: the folder.
        frames: of each turn.
        most_samples: that are shown; how many others there are is said.
        room: that is left in the page.
    """
    settings = read_object(found.path / SCENE).get("settings")
    settings = settings if isinstance(settings, dict) else {}
    image = str(settings.get("image") or found.name)
    videos = sorted(found.path.glob("orbit_*.mp4"))
    shown = videos[:most_samples]
    turning = [turntable(video, image, video.stem.replace("orbit_", "sample "), frames, room) for video in shown]
    parts = [
        element("h3", found.name),
        described({"settings": said(settings), **origin(found.path)}),
    ]
    if turning:
        parts.append(element("div", *turning, class_="samples"))
    if len(videos) > len(shown):
        parts.append(element("p", f"{len(videos) - len(shown)} more samples left out", class_="left-out"))
    if (found.path / "sheet.png").is_file():
        sheet = picture(found.path / "sheet.png", f"{image}: input, and views around each sample", room)
        parts.append(folded("Contact sheet", sheet, open_=not turning))
    return element("section", *parts, aria_label=f"Prediction {found.name}")


def said(settings: dict[str, Any]) -> str:
    """The settings that matter, in one line."""
    return ", ".join(f"{name} {_short(settings[key])}" for key, name in NAMED.items() if settings.get(key) is not None)


def _short(value: Any) -> str:
    return format(value, ".4g") if isinstance(value, float) else str(value)


POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""What the browser enforces: this page asks for nothing, whatever is in it."""
UNFOLDED = 3
"""Runs up to which all of them are; otherwise those with a report's figure."""


@dataclass(frozen=True)
class Limits:
    """How much a page holds: frames of a turn, samples of a photograph, photographs, runs, pictures of a run's folder,
    and all pictures together."""

    frames: int
    samples: int
    predictions: int
    runs: int
    pictures: int
    megabytes: float


def page(folder: Path, out: Path, limits: Limits, made: Mapping[str, str]) -> tuple[str, list[str]]:
    """The page, and a line for each file of results that could not be used.

    Args:
        folder: searched for runs and predictions.
        out: where the page goes; what lies there is not searched.
        limits: how much is shown.
        made: command, date and commit of the page itself.

    Raises:
        CompleteSplatError: there is no such folder, or nothing to show in it.
    """
    found, room = find_folders(folder, out), Room(limits.megabytes)
    tables, by_run, warnings = _tables(folder)
    predictions = [
        prediction(one, limits.frames, limits.samples, room) for one in found.predictions[: limits.predictions]
    ]
    few = len(found.runs) <= UNFOLDED
    runs = [run(one, by_run, limits.pictures, room, few or "" in one.figures) for one in found.runs[: limits.runs]]
    predictions += _more(len(found.predictions) - len(predictions), "predictions")
    runs += _more(len(found.runs) - len(runs), "runs")
    sections = {
        "Predictions": [element("p", HINT), *predictions] if predictions else [],
        "Tables": [comparison(table) for table in sorted(tables, key=is_published)],
        "Runs": runs,
        "Left out": [element("ul", *(element("li", line) for line in warnings))] if warnings else [],
    }
    title = f"completesplat: {folder.resolve().name}"
    return _document(title, {name: parts for name, parts in sections.items() if parts}, made), warnings


HINT = (
    "Move the mouse over a sample, drag a finger across it, or give it the focus and use the arrow keys: all samples "
    "of the photograph turn together. What the photograph does not show is made up, differently in each sample."
)


def _tables(folder: Path) -> tuple[list[Table], dict[str, list[Table]], list[str]]:
    """Those of `completesplat report`, those of each run by itself, and warnings."""
    try:
        all_of_them, warnings = compared(folder)
    except CompleteSplatError:  # no results: predictions or figures alone
        return [], {}, []
    found, by_run = find(folder), {}
    name = lambda one: folder.resolve().name if one.name == "." else one.name  # noqa: E731
    for one in found.scores:
        by_run[name(one)] = own_tables(entries([one]))
    for one in found.modes:
        by_run[name(one)] = [*by_run.get(name(one), []), *mode_tables([one])]
    return all_of_them, by_run, warnings


def _more(count: int, what: str) -> list[Html]:
    return [element("p", f"{count} more {what} left out", class_="left-out")] if count > 0 else []


def _document(title: str, sections: Mapping[str, list[Html]], made: Mapping[str, str]) -> str:
    style, script = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    identities = {name: name.lower().replace(" ", "-") for name in sections}
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(style)),
    )
    links = [element("li", element("a", name, href=f"#{identity}")) for name, identity in identities.items()]
    top = element("header", element("h1", title), element("nav", element("ul", *links), aria_label="Sections"))
    body = [
        element("section", element("h2", name, id=identities[name]), *parts, aria_labelledby=identities[name])
        for name, parts in sections.items()
    ]
    said = [f"{key} {value}" for key, value in made.items() if value]
    footer = element("footer", f"Made by completesplat {__version__}: {'; '.join(said)}")
    whole = element("body", top, element("main", *body), footer, element("script", Html(script)))
    return joined(Html("<!DOCTYPE html>\n"), element("html", head, whole, lang="en"), "\n")
