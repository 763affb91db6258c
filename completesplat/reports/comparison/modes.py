"""The hidden-modes benchmark: the samples of each method against the true distribution."""

from collections.abc import Sequence

from completesplat.reports.comparison.cells import Cell, Heading, Notes, Row, Table
from completesplat.reports.comparison.entries import described
from completesplat.reports.comparison.own import alike
from completesplat.reports.comparison.runs import Run

SCORES = {"coverage": "coverage ↑", "total_variation": "total variation ↓", "sharpness": "sharpness ↓"}
SCORES |= {"rejected": "rejected ↓"}
COUNTS = ("scenes", "samples")


def mode_tables(runs: Sequence[Run]) -> list[Table]:
    """One for each protocol and number of samples."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(f"{alike(run.protocol)} {run.protocol.get('samples')}", []).append(run)
    return [_table(f"hidden_modes_{index}", groups[key]) for index, key in enumerate(sorted(groups), 1)]


def _table(name: str, runs: Sequence[Run]) -> Table:
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
