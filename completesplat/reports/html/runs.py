"""Runs: what each scored, was set to, and drew."""

from collections.abc import Mapping
from pathlib import Path

from completesplat.reports.comparison.cells import Table
from completesplat.reports.html.finding import CONFIG, ROWS, Folder, origin, read_object
from completesplat.reports.html.markup import Html, described, element, folded
from completesplat.reports.html.pictures import Room, picture
from completesplat.reports.html.tables import comparison, rows_of

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
