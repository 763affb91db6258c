"""The page as a whole."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from completesplat import __version__
from completesplat.errors import CompleteSplatError
from completesplat.reports.comparison import runs as results
from completesplat.reports.comparison.building import tables as compared
from completesplat.reports.comparison.cells import Table
from completesplat.reports.comparison.entries import entries
from completesplat.reports.comparison.modes import mode_tables
from completesplat.reports.comparison.own import own_tables
from completesplat.reports.html.finding import find
from completesplat.reports.html.markup import Html, element, joined
from completesplat.reports.html.pictures import Room
from completesplat.reports.html.predictions import prediction
from completesplat.reports.html.runs import run
from completesplat.reports.html.tables import comparison, is_published

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
    found, room = find(folder, out), Room(limits.megabytes)
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
    found, by_run = results.find(folder), {}
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
