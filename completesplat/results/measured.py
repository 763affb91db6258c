"""Tables of our scores, one for each protocol, so that the rows of a table can be compared."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from completesplat.results.runs import MODEL, UPPER_BOUND, Protocol, Result, Scores
from completesplat.results.tables import (
    ABSENT,
    LEGEND,
    METRICS,
    SSIM_NOTE,
    Cell,
    Heading,
    Notes,
    Table,
    TableRow,
    marks,
    score_cell,
    score_heading,
)

BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K = "best_of_k", "best_of_k_by_metric", "mean_of_k"
OURS = "completesplat: "  # not "ours", because the paper gives its rows that name
COST = {"inference": "inference", "rendering": "rendering"}
LEADING = {"method": "method", "speed": "rendering speed", **COST, "scenes": "scenes", "resolution": "pixels"}
"""The columns before the scores, and their headings."""

ALIKE = ["name", "data_set", "subset", "split", "resolution", "crop", "background", "precision", "scenes", "skipped"]
ALIKE += ["views", "protocol_views", "scene_list"]
"""Entries of the protocol that are equal in all rows of a table, as are the data and the settings of the metrics."""
DESCRIBED = [*ALIKE, "image_size", "scenes_listed", "samples", "criterion", "seed", "sampler", "steps", "skip_weight"]
DESCRIBED += ["guidance_weight", "color_fits", "ema", "commit", "frame", "align", "fitted_to"]
"""Entries of the protocol that the note on a row states."""
COLUMNS = [f"full_novel_{name}" for name in METRICS]
COLUMNS += [f"object_novel_{name}" for name in ("psnr", "ssim", "lpips", "sharpness")] + ["full_reference_psnr"]
"""Scores that a table shows if a run has them."""
MODE_SCORES = {"coverage": "coverage ↑", "total_variation": "total variation ↓", "sharpness": "sharpness ↓"}
MODE_SCORES |= {"rejected": "rejected ↓"}
MODES_EXPLAINED = (
    "Coverage: share of the modes that samples hit. Total variation: of the samples' distribution from the true one. "
    "Sharpness: distance to the nearest mode over that of the modes' mean. Rejected: share of the samples."
)

Measured = TypeVar("Measured")


def alike(measurements: Iterable[tuple[Measured, Protocol]], *more: str) -> list[list[Measured]]:
    """Group measurements by equal protocols, in a fixed order; only scores within a group can be compared."""
    groups: dict[str, list[Measured]] = {}
    for measured, protocol in measurements:
        values: Mapping[str, object] = protocol
        compared = [values.get(name) for name in (*ALIKE, "data_fingerprint", "metrics", *more)]
        groups.setdefault(json.dumps(compared, sort_keys=True), []).append(measured)
    return [groups[key] for key in sorted(groups)]


def described(protocol: Protocol, keys: Sequence[str] = DESCRIBED) -> str:
    """Describe a protocol in one line."""
    values: Mapping[str, object] = protocol
    known = {key: value for key in keys if (value := values.get(key)) is not None}
    parts = [f"{key} {len(value) if isinstance(value, list) else value}" for key, value in known.items()]
    if keys is DESCRIBED:
        checkpoint = protocol.get("checkpoint", {})
        parts += [f"checkpoint {key} {str(checkpoint[key])[:12]}" for key in ("step", "sha256") if checkpoint.get(key)]
    parts += [f"data {protocol['data_fingerprint'][:12]}"] if protocol.get("data_fingerprint") else []
    if machine := protocol.get("machine"):
        parts.append(f"on {machine.get('gpu') or machine.get('processor')}, {machine.get('date')}")
    return ", ".join(parts)


@dataclass(frozen=True)
class Entry:
    """Scores of one predictor in one run."""

    run: Result
    predictor: str
    scores: Scores

    @property
    def ours(self) -> bool:
        """Whether the predictor is the run's model rather than a naive one."""
        return self.predictor in (MODEL, BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K)

    @property
    def upper_bound(self) -> bool:
        """Whether the predictor has seen the views that it is scored on."""
        return bool(self.scores.get(UPPER_BOUND))

    def method(self, notes: Notes) -> Cell:
        """Return the method, its kind of sampling, and the number of the note that describes the protocol."""
        protocol, label = self.run.protocol, self.predictor.replace("_", " ")
        if self.ours:
            samples = protocol.get("samples", 1)
            oracle, criterion = f", {samples}-best oracle by", str(protocol.get("criterion")).upper()
            kinds = {BEST_OF_K: f"{oracle} {criterion}", BEST_BY_METRIC: f"{oracle} each metric"}
            kinds[MEAN_OF_K] = f", mean of {samples} samples"
            kinds[MODEL] = ", single sample" if protocol.get("sampler") or samples != 1 else ""
            label = f"{protocol.get('method', 'model')}{kinds[self.predictor]}"
            label += " (upper bound)" if self.upper_bound else ""
        owner = "" if self.ours and protocol.get("frame") else OURS  # any program may have written the files
        return Cell(f"{owner}{label} [{_note(self.run, notes)}]")

    def cell(self, name: str, notes: Notes) -> Cell:
        """Return a cell with the score `REGION_VIEW_METRIC`, or with the number of the note on why it is missing."""
        if (value := self.scores.get(name)) is not None:
            return score_cell(name, value)
        return notes.missing(name, self.run.protocol, f"not measured for {self.predictor}")

    def leading(self, notes: Notes) -> dict[str, Cell]:
        """Return the cells before the scores, by the keys of `LEADING`; unknown values are `ABSENT`."""
        protocol = self.run.protocol
        times = {part: time_cell(self.scores.get(f"seconds_{part}")) for part in COST}
        sizes = {"scenes": Cell(str(protocol["scenes"])), "resolution": Cell(str(protocol["resolution"]))}
        return {"method": self.method(notes), "speed": Cell(ABSENT), **times, **sizes}


def _note(run: Result, notes: Notes) -> int:
    return notes.number(f"{run.name}: {described(run.protocol)}.")


def leading_headings(keys: Iterable[str]) -> list[Heading]:
    """Return headings for some keys of `LEADING`."""
    named = [(key, "time per sequence" if key in COST else "") for key in keys]
    return [Heading(LEADING[key], group, key not in ("method", "speed")) for key, group in named]


def entries(runs: Sequence[Result]) -> list[Entry]:
    """Return all entries of all runs, in the order of their files."""
    return [Entry(run, predictor, scores) for run in runs for predictor, scores in run.entries.items()]


def time_cell(seconds: float | None) -> Cell:
    """Return a time in the paper's units: `15.7 ms`, `2.7 sec`, `4.1 min`."""
    if seconds is None:
        return Cell(ABSENT)
    if seconds < 1:
        text = f"{1000 * seconds:.1f} ms"
    else:
        text = f"{seconds:.1f} sec" if seconds < 60 else f"{seconds / 60:.1f} min"
    return Cell(text, value=seconds)


def score_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each protocol, in the order of data sets and protocols."""
    groups = alike((entry, entry.run.protocol) for entry in entries)
    return [_score_table(f"own_{index}", group) for index, group in enumerate(groups, 1)]


def _score_table(name: str, entries: Sequence[Entry]) -> Table:
    protocol, notes = entries[0].run.protocol, Notes()
    # Our models first; a naive predictor has the same scores in all runs of a protocol, so it is shown once.
    naive: dict[object, Entry] = {}
    for entry in entries:
        scores = {key: value for key, value in entry.scores.items() if not key.startswith("seconds")}
        if not entry.ours:
            naive.setdefault((entry.predictor, *scores.items()), entry)
    selected = [*(entry for entry in entries if entry.ours), *naive.values()]
    columns = [column for column in COLUMNS if any(_known(entry, column) for entry in selected)]
    competing = [entry.ours and not entry.upper_bound for entry in selected]
    marked = {name: marks([entry.scores.get(name) for entry in selected], competing, name) for name in columns}
    identity = [key for key in LEADING if key != "speed"]
    rows = []
    for index, entry in enumerate(selected):
        leading = entry.leading(notes)
        cells = [leading[key] for key in identity]
        cells += [replace(entry.cell(name, notes), mark=marked[name][index]) for name in columns]
        rows.append(TableRow("ours" if entry.ours else "naive", cells))
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = ["Ours, best in bold and second best underlined; not by the protocol of any published table."]
    remarks += [f"Measured alike in all rows. {SSIM_NOTE}", LEGEND]
    return Table(name, title, [*leading_headings(identity), *map(score_heading, columns)], rows, remarks, notes)


def _known(entry: Entry, column: str) -> bool:
    """Return whether an entry has the score of a column, or a stated reason for lacking it."""
    region, _, name = column.split("_")
    stated = name in entry.run.protocol.get("missing", {}) and any(key.startswith(region) for key in entry.scores)
    return stated or column in entry.scores


def mode_tables(runs: Sequence[Result]) -> list[Table]:
    """Return a table for each protocol and number of samples."""
    groups = alike(((run, run.protocol) for run in runs), "samples")
    return [_mode_table(f"hidden_modes_{index}", group) for index, group in enumerate(groups, 1)]


def _mode_table(name: str, runs: Sequence[Result]) -> Table:
    notes = Notes()
    rows: dict[str, dict[object, list[Cell]]] = {"ours": {}, "known": {}}
    for run in runs:
        for method, scores in run.entries.items():
            label = str(run.protocol.get("method", "model")) if method == MODEL else method.replace("_", " ")
            cells = [Cell(f"{scores[key]:.3f}", value=scores[key]) for key in MODE_SCORES]
            cells += [Cell(f"{scores[key]:g}") for key in ("scenes", "samples")]
            # Methods other than the model may have the same scores in several runs, and are then shown once.
            key, source = (run.name, "ours") if method == MODEL else ((label, *cells), "known")
            rows[source].setdefault(key, [Cell(f"{label} [{_note(run, notes)}]"), *cells])
    headings = [Heading("method", figures=False), *map(Heading, [*MODE_SCORES.values(), "scenes", "samples"])]
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {protocol.get('data_fingerprint', 'unknown')[:12]}"
    body = [TableRow(source, cells) for source, members in rows.items() for cells in members.values()]
    return Table(name, f"Hidden modes, {data}", headings, body, [MODES_EXPLAINED], notes)
