"""Tables of our own scores, one for each protocol, so that all rows of a table compare."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from completesplat.results.runs import Result
from completesplat.results.scores import LEADING, MODEL, Entry, described, leading_headings
from completesplat.results.tables import (
    LEGEND,
    METRICS,
    SSIM_NOTE,
    Cell,
    Heading,
    Notes,
    Table,
    TableRow,
    marks,
    score_heading,
)

ALIKE = [
    "data_set",
    "subset",
    "split",
    "name",
    "resolution",
    "scenes",
    "skipped",
    "views",
    "protocol_views",
    "scene_list",
]
ALIKE += ["crop", "background", "precision", "data_fingerprint", "metrics"]
"""Entries that are equal in the protocols of all rows of a table."""
SAID = ["subset", "split", "resolution", "scenes", "scenes_listed", "skipped", "views", "protocol_views", "scene_list"]
SAID += ["crop", "background", "precision"]
"""Entries of the protocol that a table states."""
COLUMNS = [f"full_novel_{name}" for name in METRICS]
COLUMNS += [f"object_novel_{name}" for name in ("psnr", "ssim", "lpips")] + ["full_reference_psnr"]
"""Scores that a table shows if a run has them."""
IDENTITY = [key for key in LEADING if key != "speed"]

SCORES = {"coverage": "coverage ↑", "total_variation": "total variation ↓", "sharpness": "sharpness ↓"}
SCORES |= {"rejected": "rejected ↓"}
COUNTS = ("scenes", "samples")
MODES_SAID = (
    "Coverage: share of the modes that samples hit. Total variation: of the samples' distribution from the true one. "
    "Sharpness: distance to the nearest mode over that of the modes' mean. Rejected: share of the samples."
)


Measured = TypeVar("Measured")


def alike(found: Iterable[tuple[Measured, dict[str, Any]]], *more: str) -> dict[str, list[Measured]]:
    """Group measurements by equal protocols (a key of them): scores compare within a group only."""
    groups: dict[str, list[Measured]] = {}
    for measured, protocol in found:
        key = json.dumps([protocol.get(name) for name in (*ALIKE, *more)], sort_keys=True, default=str)
        groups.setdefault(key, []).append(measured)
    return groups


def own_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return the tables, in the order of data sets and protocols."""
    groups = alike((entry, entry.run.protocol) for entry in entries)
    return [_table(f"own_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def protocol_said(protocol: dict[str, Any]) -> str:
    """Return sentences on what is common to a table's rows."""
    parts = [f"{key} {protocol[key]}" for key in SAID if protocol.get(key) is not None]
    fingerprint = protocol.get("data_fingerprint")
    parts += [f"data fingerprint {str(fingerprint)[:12]}"] if fingerprint else []
    return f"Measured alike in all rows: {', '.join(parts)}. {SSIM_NOTE}"


def _table(name: str, entries: Sequence[Entry]) -> Table:
    protocol, notes = entries[0].run.protocol, Notes()
    # Our models first; a naive predictor has the same scores in all runs of a protocol, so it is shown once.
    naive: dict[str, Entry] = {}
    for entry in entries:
        if not entry.own:
            naive.setdefault(entry.predictor + json.dumps(entry.scores | {"seconds": None}, sort_keys=True), entry)
    kept_entries = [*(entry for entry in entries if entry.own), *naive.values()]
    columns = [column for column in COLUMNS if any(_known(entry, column) for entry in kept_entries)]
    competing = [entry.own and not entry.upper_bound for entry in kept_entries]
    marked = {name: marks([entry.value(name) for entry in kept_entries], competing, name) for name in columns}
    rows = []
    for index, entry in enumerate(kept_entries):
        leading = entry.leading(notes)
        cells = [leading[key] for key in IDENTITY]
        cells += [replace(entry.cell(name, notes), mark=marked[name][index]) for name in columns]
        rows.append(TableRow("ours" if entry.own else "naive", cells))
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = ["Ours, best in bold and second best underlined; not by the protocol of any published table."]
    remarks += [protocol_said(protocol), LEGEND]
    return Table(name, title, [*leading_headings(IDENTITY), *map(score_heading, columns)], rows, remarks, notes)


def _known(entry: Entry, column: str) -> bool:
    """Return whether a column has a figure, or a reason why it has none."""
    region, _, name = column.split("_")
    stated = name in (entry.run.protocol.get("missing") or {}) and region in entry.scores
    return stated or entry.value(column) is not None


def mode_tables(runs: Sequence[Result]) -> list[Table]:
    """Return a table for each protocol and number of samples."""
    groups = alike(((run, run.protocol) for run in runs), "samples")
    return [_modes_table(f"hidden_modes_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def _modes_table(name: str, runs: Sequence[Result]) -> Table:
    notes, seen = Notes(), []
    rows: dict[str, list[TableRow]] = {"ours": [], "known": []}

    def to_cell(scores: dict[str, Any], key: str, form: str) -> Cell:
        value = scores.get(key)
        if not isinstance(value, int | float):
            return notes.missing(f"{key.replace('_', ' ')}: the file of results holds none")
        return Cell(format(value, form), value=float(value) if form else None)

    for run in runs:
        for method, scores in run.entries.items():
            label = str(run.protocol.get("method", "model")) if method == MODEL else method.replace("_", " ")
            cells = [to_cell(scores, key, ".3f") for key in SCORES] + [to_cell(scores, key, "") for key in COUNTS]
            if method == MODEL or (label, cells) not in seen:  # other methods are the same in all runs
                seen.append((label, cells))
                source = "ours" if method == MODEL else "known"
                rows[source].append(TableRow(source, [Cell(f"{label} [{notes.number(described(run))}]"), *cells]))
    headings = [Heading("method", figures=False), *map(Heading, SCORES.values()), *map(Heading, COUNTS)]
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {str(protocol.get('data_fingerprint', 'unknown'))[:12]}"
    return Table(name, f"Hidden modes, {data}", headings, [*rows["ours"], *rows["known"]], [MODES_SAID], notes)
