"""Tables of our own scores: one for each way of measuring, so that all rows of a table compare."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from completesplat.results.runs import Result
from completesplat.results.scores import MODEL, Entry, described
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

ALIKE = ["data_set", "subset", "split", "name", "resolution", "scenes", "skipped", "views", "protocol_views", "crop"]
ALIKE += ["precision", "data_fingerprint", "metrics"]
"""What the protocols of a table's rows have in common."""
SAID = ["subset", "split", "resolution", "scenes", "scenes_listed", "skipped", "views", "protocol_views", "crop"]
SAID += ["precision"]
"""What a table says of its protocol."""
COLUMNS = [f"full_novel_{name}" for name in METRICS]
COLUMNS += [f"object_novel_{name}" for name in ("psnr", "ssim", "lpips")] + ["full_reference_psnr"]
"""The scores that a table shows where a run has them."""
IDENTITY = [Heading("method", figures=False), Heading("inference", "time per sequence")]
IDENTITY += [Heading("rendering", "time per sequence"), Heading("scenes"), Heading("pixels")]

SCORES = {"coverage": "coverage ↑", "total_variation": "total variation ↓", "sharpness": "sharpness ↓"}
SCORES |= {"rejected": "rejected ↓"}
COUNTS = ("scenes", "samples")


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
    competing = [entry.own and not entry.upper_bound for entry in kept]
    marked = {name: marks([entry.value(name) for entry in kept], competing, name) for name in shown}
    rows = []
    for index, entry in enumerate(kept):
        size = [Cell(str(protocol[key])) for key in ("scenes", "resolution")]
        cells = [entry.method(notes), entry.time("inference"), entry.time("rendering"), *size]
        cells += [replace(entry.cell(name, notes), mark=marked[name][index]) for name in shown]
        rows.append(TableRow("ours" if entry.own else "naive", cells))
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = ["Ours, best in bold and second best underlined; not by the protocol of any published table."]
    remarks += [protocol_said(protocol), LEGEND]
    return Table(name, title, [*IDENTITY, *map(score_heading, shown)], rows, remarks, notes)


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


def _known(entry: Entry, column: str) -> bool:
    """Whether a column has something to say: a figure, or why there is none."""
    region, _, name = column.split("_")
    stated = name in (entry.run.protocol.get("missing") or {}) and region in entry.scores
    return stated or entry.value(column) is not None


def mode_tables(runs: Sequence[Result]) -> list[Table]:
    """One for each protocol and number of samples."""
    groups: dict[str, list[Result]] = {}
    for run in runs:
        groups.setdefault(f"{alike(run.protocol)} {run.protocol.get('samples')}", []).append(run)
    return [_modes_table(f"hidden_modes_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def _modes_table(name: str, runs: Sequence[Result]) -> Table:
    notes = Notes()
    ours: list[TableRow] = []
    known: list[TableRow] = []
    seen = []
    for run in runs:
        for method, scores in run.entries.items():
            label = f"{run.protocol.get('method', 'model')}" if method == MODEL else method.replace("_", " ")
            cells = [_cell(scores, key, ".3f", notes) for key in SCORES] + [
                _cell(scores, key, "", notes) for key in COUNTS
            ]
            if method != MODEL and (label, cells) in seen:  # what is no model is the same in all runs
                continue
            seen.append((label, cells))
            first = Cell(f"{label} [{notes.number(described(run))}]")
            rows, source = (ours, "ours") if method == MODEL else (known, "known")
            rows.append(TableRow(source, [first, *cells]))
    headings = [Heading("method", figures=False), *map(Heading, SCORES.values()), *map(Heading, COUNTS)]
    remarks = [
        "Coverage: share of the modes that samples hit. Total variation: of the samples' distribution from the true "
        "one. Sharpness: distance to the nearest mode over that of the modes' mean. Rejected: share of the samples.",
    ]
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {str(protocol.get('data_fingerprint', 'unknown'))[:12]}"
    return Table(name, f"Hidden modes, {data}", headings, [*ours, *known], remarks, notes)


def _cell(scores: dict[str, Any], key: str, form: str, notes: Notes) -> Cell:
    value = scores.get(key)
    if not isinstance(value, int | float):
        return notes.missing(f"{key.replace('_', ' ')}: the file of results holds none")
    return Cell(format(value, form), value=float(value) if form else None)
