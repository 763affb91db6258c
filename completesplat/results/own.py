"""Tables of our own scores: one for each way of measuring, so that all rows of a table compare."""

import json
from collections.abc import Sequence
from typing import Any

from completesplat.results.rows import Entry, described
from completesplat.results.runs import Run
from completesplat.results.tables import (
    GROUPS,
    LEGEND,
    METRICS,
    SSIM_NOTE,
    Cell,
    Heading,
    Notes,
    Row,
    Table,
    marks,
    metric,
)

ALIKE = (
    "data_set",
    "subset",
    "split",
    "name",
    "resolution",
    "scenes",
    "skipped",
    "views",
    "protocol_views",
    "crop",
    "precision",
    "data_fingerprint",
    "metrics",
)
"""What the protocols of a table's rows have in common."""
WHICH = ("subset", "split", "resolution", "scenes", "scenes_listed", "skipped")
SAID = (*WHICH, "views", "protocol_views", "crop", "precision")
COLUMNS = [f"full_novel_{name}" for name in METRICS]
COLUMNS += [f"object_novel_{name}" for name in ("psnr", "ssim", "lpips")] + ["full_reference_psnr"]
IDENTITY = [Heading("method", figures=False), Heading("inference", "time per sequence")]
IDENTITY += [Heading("rendering", "time per sequence"), Heading("scenes"), Heading("pixels")]


def alike(protocol: dict[str, Any]) -> str:
    """A key that is equal for protocols whose scores compare."""
    return json.dumps([protocol.get(key) for key in ALIKE], sort_keys=True, default=str)


def own_tables(entries: Sequence[Entry]) -> list[Table]:
    """The tables, in the order of data sets and protocols."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(alike(entry.run.protocol), []).append(entry)
    return [_table(f"own_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def protocol_said(protocol: dict[str, Any]) -> str:
    """What is common to a table's rows, in sentences."""
    said = [f"{key} {protocol[key]}" for key in SAID if protocol.get(key) is not None]
    fingerprint = protocol.get("data_fingerprint")
    said += [f"data fingerprint {str(fingerprint)[:12]}"] if fingerprint else []
    return f"Measured alike in all rows: {', '.join(said)}. {SSIM_NOTE}"


def _table(name: str, entries: Sequence[Entry]) -> Table:
    protocol, notes = entries[0].run.protocol, Notes()
    kept = _distinct(entries)
    shown = [column for column in COLUMNS if any(_known(entry, column) for entry in kept)]
    marked = {column: marks([_ranked(entry, column) for entry in kept], column) for column in shown}
    rows = []
    for index, entry in enumerate(kept):
        label = f"{entry.label()} [{notes.number(described(entry.run))}]"
        size = [Cell(str(protocol[key])) for key in ("scenes", "resolution")]
        cells = [Cell(label), entry.time("inference"), entry.time("rendering"), *size]
        for column in shown:
            cell = entry.cell(*_parts(column), notes)
            cells.append(Cell(cell.text, marked[column][index], cell.value))
        rows.append(Row("ours" if entry.own else "naive", cells))
    headings = [*IDENTITY, *(Heading(metric(column), GROUPS[column.rpartition("_")[0]]) for column in shown)]
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = ["Ours, best in bold and second best underlined; not by the protocol of any published table."]
    return Table(name, title, headings, rows, [*remarks, protocol_said(protocol), LEGEND], notes)


def _distinct(entries: Sequence[Entry]) -> list[Entry]:
    """Own models first; a naive predictor, which scores the same in all runs of a protocol, once."""
    seen, naive = set(), []
    for entry in entries:
        scores = {key: value for key, value in entry.scores.items() if key != "seconds"}
        key = entry.predictor + json.dumps(scores, sort_keys=True)
        if not entry.own and key not in seen:
            seen.add(key)
            naive.append(entry)
    return [*(entry for entry in entries if entry.own), *naive]


def _parts(column: str) -> tuple[str, str, str]:
    region, view, name = column.split("_")
    return region, view, name


def _known(entry: Entry, column: str) -> bool:
    """Whether a column has something to say: a figure, or why there is none."""
    region, view, name = _parts(column)
    stated = name in (entry.run.protocol.get("missing") or {}) and region in entry.scores
    return stated or entry.value(region, view, name) is not None


def _ranked(entry: Entry, column: str) -> dict[str, Any]:
    """As the rows of a sweep are ranked: naive predictors and upper bounds do not compete."""
    seeds = 1 if entry.own else None
    return {"seeds": seeds, "upper_bound": entry.upper_bound, f"{column}_mean": entry.value(*_parts(column))}


SCORES = {"coverage": "coverage ↑", "total_variation": "total variation ↓", "sharpness": "sharpness ↓"}
SCORES |= {"rejected": "rejected ↓"}
COUNTS = ("scenes", "samples")


def mode_tables(runs: Sequence[Run]) -> list[Table]:
    """One for each protocol and number of samples."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(f"{alike(run.protocol)} {run.protocol.get('samples')}", []).append(run)
    return [_modes_table(f"hidden_modes_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def _modes_table(name: str, runs: Sequence[Run]) -> Table:
    notes = Notes()
    rows, seen = [], []
    for run in runs:
        for method, scores in run.entries.items():
            label = f"{run.protocol.get('method', 'model')}" if method == "model" else method.replace("_", " ")
            cells = [_cell(scores, key, notes) for key in SCORES]
            cells += [Cell(str(scores[key])) if key in scores else _cell(scores, key, notes) for key in COUNTS]
            if method == "model" or (label, cells) not in seen:  # what is no model is the same in all runs
                seen.append((label, cells))
                rows.append(Row("ours" if method == "model" else "known", _noted(label, run, notes) + cells))
    rows.sort(key=lambda row: row.source != "ours")
    headings = [Heading("method", figures=False), *map(Heading, SCORES.values()), *map(Heading, COUNTS)]
    remarks = [
        "Coverage: share of the modes that samples hit. Total variation: of the samples' distribution from the true "
        "one. Sharpness: distance to the nearest mode over that of the modes' mean. Rejected: share of the samples.",
    ]
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {str(protocol.get('data_fingerprint', 'unknown'))[:12]}"
    return Table(name, f"Hidden modes, {data}", headings, rows, remarks, notes)


def _noted(label: str, run: Run, notes: Notes) -> list[Cell]:
    return [Cell(f"{label} [{notes.number(described(run))}]")]


def _cell(scores: dict, key: str, notes: Notes) -> Cell:
    value = scores.get(key)
    if not isinstance(value, int | float):
        return notes.missing(f"{key.replace('_', ' ')}: the file of results holds none")
    return Cell(format(value, ".3f"), value=float(value))
