"""The board: a table for each protocol that has a list of scenes, with the results in the package and a user's own."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.board_results import COPY, COPY_SCORE, BoardResult, read_results, refusal
from completesplat.evaluation.protocol import board_of
from completesplat.evaluation.records import BEST_OF_K, MODEL
from completesplat.evaluation.table_writers import as_markdown, markdown
from completesplat.evaluation.tables import (
    SHARPNESS_NOTE,
    SSIM_NOTE,
    Cell,
    Heading,
    Table,
    TableRow,
    marks,
    score_cell,
)
from completesplat.files import write_text
from completesplat.metrics import METRIC_FORMATS, MetricFormat
from completesplat.settings.composition import compose
from completesplat.settings.options import options

BOARD = Path(__file__).parent / "board"
"""Folder of the results in the package: `PROTOCOL/NAME.json`, and perhaps `PROTOCOL/NAME.jpg` beside it."""
ALL = "all pixels"
OBJECT = "object pixels"
INPUT = "input view"
IMAGE_COLUMNS = {
    "full_novel_psnr": (ALL, METRIC_FORMATS["psnr"]),
    "full_novel_ssim": (ALL, METRIC_FORMATS["ssim"]),
    "full_novel_lpips": (ALL, METRIC_FORMATS["lpips"]),
    "object_novel_psnr": (OBJECT, METRIC_FORMATS["psnr"]),
    "object_novel_ssim": (OBJECT, METRIC_FORMATS["ssim"]),
    "object_novel_sharpness": (OBJECT, METRIC_FORMATS["sharpness"]),
    "full_reference_psnr": (INPUT, METRIC_FORMATS["psnr"]),
}
MODE_COLUMNS = {
    "coverage": ("", MetricFormat("coverage", "↑")),
    "total_variation": ("", MetricFormat("total variation", "↓")),
    "mode_distance": ("", MetricFormat("mode distance", "↓")),
    "rejected": ("", MetricFormat("rejected", "↓")),
    "energy_hidden": ("", MetricFormat("energy hidden", "↓", 4)),
    "energy_visible": ("", MetricFormat("energy visible", "↓", 4)),
}
NAIVE = {
    COPY: "copy of the input",
    "mirrored_reference": "the input, mirrored",
    "flat_reference": "the input on a plane",
    "mean_image": "mean image of training",
    "true_sampler": "draws of the true modes",
    "mean_predictor": "mean of the true modes",
}
ERRORS_NOTE = "±: standard error over the scenes."
METHODS, NAIVES, PUBLISHED = "methods", "naive", "published"
"""Sources of rows, between which a table has rules."""

Columns = Mapping[str, tuple[str, MetricFormat]]


@dataclass(frozen=True)
class BoardSection:
    """One protocol of the board: its config, the results of its table, and why others are left out."""

    name: str
    board: Mapping[str, Any]
    results: list[BoardResult]
    refused: list[str]


@dataclass(frozen=True)
class _Row:
    """Row of a table before it is written. A row that does not compete has no marks."""

    source: str
    label: str
    scores: Mapping[str, tuple[float | None, float | None]]
    competes: bool = False
    measured: str = ""


def board_protocols() -> dict[str, Mapping[str, Any]]:
    """Return `board` of the protocols that have one, by the protocols' names.

    Raises:
        CompleteSplatError: a user's protocol cannot be read, or an entry of its `board` is missing.
    """
    protocols = {}
    for name in options("evaluation"):
        try:
            evaluation: Any = OmegaConf.to_container(compose("test", f"evaluation={name}").evaluation)
        except (HydraException, OmegaConfBaseException, YAMLError) as error:
            raise CompleteSplatError(f"evaluation={name}: {error}") from error
        board = board_of(evaluation)
        if board is not None:
            protocols[name] = board
    return protocols


def board_sections(added: Sequence[BoardResult]) -> list[BoardSection]:
    """Return all protocols with the results in the package, and those of a user that belong to them."""
    stored = read_results(BOARD).results
    sections = []
    for name, board in board_protocols().items():
        accepted: list[BoardResult] = []
        refused = []
        for result in (*stored, *added):
            if result.protocol != name:
                continue
            reason = refusal(result, board["conditions"], _copied(accepted))
            if reason is None:
                accepted.append(result)
            else:
                refused.append(f"{result.file}: left out, because {reason}")
        sections.append(BoardSection(name, board, accepted, refused))
    return sections


def _copied(results: Sequence[BoardResult]) -> float | None:
    """Return the PSNR of the copy of the input image in the first result that has it."""
    for result in results:
        copy, _ = result.score(COPY, COPY_SCORE)
        if copy is not None:
            return copy
    return None


def board_table(section: BoardSection) -> Table:
    """Return the table of one protocol: methods by their first score, naive predictors, published figures."""
    modes = any("coverage" in result.content["scores"].get(MODEL, {}) for result in section.results)
    columns = MODE_COLUMNS if modes else IMAGE_COLUMNS
    rows = [*_methods(section, columns), *_naive(section, columns), *_published(section, columns)]
    columns = {name: column for name, column in columns.items() if any(_mean(row, name) is not None for row in rows)}
    headings = [Heading("method", figures=False)]
    headings += [Heading(f"{form.heading} {form.better}".rstrip(), group) for group, form in columns.values()]
    headings.append(Heading("measured", figures=False))
    remarks = []
    if section.results:
        remarks = [ERRORS_NOTE] if modes else [ERRORS_NOTE, SSIM_NOTE, SHARPNESS_NOTE]
    title = f"{section.board['title']} (evaluation={section.name})"
    return Table(section.name, title, headings, _table_rows(rows, columns), remarks)


def _table_rows(rows: Sequence[_Row], columns: Columns) -> list[TableRow]:
    """Return the cells of all rows: label, scores with the marks of the best, and when they were measured."""
    competing = [row.competes for row in rows]
    written = [[Cell(row.label)] for row in rows]
    for name, (_, form) in columns.items():
        marked = marks([_mean(row, name) for row in rows], competing, form)
        for row, cells, mark in zip(rows, written, marked, strict=True):
            mean, error = row.scores.get(name, (None, None))
            cells.append(score_cell(form, mean, error, mark))
    return [TableRow(row.source, [*cells, Cell(row.measured)]) for row, cells in zip(rows, written, strict=True)]


def _mean(row: _Row, name: str) -> float | None:
    return row.scores.get(name, (None, None))[0]


def _methods(section: BoardSection, columns: Columns) -> list[_Row]:
    rows = []
    for result in section.results:
        described = result.content["described"]
        upper_bound = bool(result.content.get("upper_bound"))
        label = result.method
        if upper_bound:
            label += " (has seen the scored views)"
        if described.get("align") == "scale":
            label += " (scale fitted to true depth)"
        date = described["machine"].get("date", "")
        commit, _, changed = str(described.get("commit") or described.get("version")).partition("-")
        measured = f"{date}, {commit[:8]}{' and changes' if changed else ''}"
        scores = {name: result.score(MODEL, name) for name in columns}
        rows.append(_Row(METHODS, label, scores, not upper_bound, measured))
        if BEST_OF_K in result.content["scores"]:
            best = {name: result.score(BEST_OF_K, name) for name in columns}
            rows.append(_Row(METHODS, f"{label}, best of {described['samples']} (an oracle)", best, False, measured))
    first = next(iter(columns))
    return sorted(rows, key=lambda row: -(_mean(row, first) or 0))


def _naive(section: BoardSection, columns: Columns) -> list[_Row]:
    """Return the naive predictors, each from the first result that has it."""
    rows = []
    for predictor, label in NAIVE.items():
        for result in section.results:
            if predictor in result.content["scores"]:
                scores = {name: result.score(predictor, name) for name in columns}
                rows.append(_Row(NAIVES, label, scores))
                break
    return rows


def _published(section: BoardSection, columns: Columns) -> list[_Row]:
    rows = []
    for figures in section.board["published"]:
        scores = {name: (value, None) for name, value in figures["scores"].items() if name in columns}
        rows.append(_Row(PUBLISHED, f"{figures['method']}, as published", scores, measured=figures["source"]))
    return rows


def write_page() -> None:
    """Write the page of the results in the package, beside them (`make board`)."""
    write_text(BOARD / "README.md", board_markdown(board_sections(()), BOARD))


def board_markdown(sections: Sequence[BoardSection], folder: Path) -> str:
    """Return the board as Markdown, with links to pictures relative to `folder`, in which it will lie."""
    parts = ["# Board", INTRODUCTION]
    for section in sorted(sections, key=lambda section: not section.results):
        table = as_markdown(board_table(section))
        heading, _, rest = table.partition("\n")
        about = markdown(" ".join(str(section.board["about"]).split()))
        if section.results or section.board["published"]:
            parts += [heading, about, rest.strip()]
        else:
            parts += [heading, about, "No results yet."]
        for result in section.results:
            if result.picture is not None:
                link = quote(Path(os.path.relpath(result.picture, folder)).as_posix())
                parts.append(f"![Renders of {markdown(result.method)}]({link})")
                parts.append(f"{markdown(result.method)}: the input, then pairs of a true view and its render.")
    return "\n\n".join(parts) + "\n"


INTRODUCTION = (
    "Scores of methods that complete a scene from one image, on public objects, each by one protocol: the same list of "
    "scenes, input view, scored views, size and background. `make board` writes this page from the files beside it. "
    "[How to add a method](../README.md#the-board)."
)
