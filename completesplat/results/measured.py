"""Tables of our scores, one for each protocol, so that the rows of a table can be compared."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from completesplat.files import counted
from completesplat.metrics import STYLES, Style
from completesplat.results.runs import MODEL, PROTOCOL, UPPER_BOUND, FlatScores, Protocol, ResultsFile, flat_scores
from completesplat.results.tables import (
    ABSENT,
    LEGEND,
    SHARPNESS_NOTE,
    SSIM_NOTE,
    UNMARKED,
    Cell,
    Heading,
    Notes,
    Table,
    TableRow,
    marks,
    metric_of,
    records_table,
    score_cell,
    score_heading,
    shown_scores,
)

BEST_OF_K = "best_of_k"
BEST_BY_METRIC = "best_of_k_by_metric"
MEAN_OF_K = "mean_of_k"
OURS = "completesplat: "  # not "ours", because the paper gives its rows that name
COST = {"inference": "inference", "rendering": "rendering"}
LEADING = {"method": "method", "speed": "rendering speed", **COST, "seeds": "seeds", "scenes": "scenes"}
LEADING |= {"resolution": "pixels"}
"""The columns before the scores, and their headings."""
OF_RUNS = ["method", *COST, "scenes", "resolution"]

ALIKE = ["name", "data_set", "subset", "split", "resolution", "crop", "background", "precision", "scenes", "skipped"]
ALIKE += ["views", "protocol_views", "scene_list"]
"""Entries of the protocol that are equal in all rows of a table, as are the data and the settings of the metrics."""
DESCRIBED = [*ALIKE, "image_size", "scenes_listed", "samples", "criterion", "seed", "sampler", "steps", "skip_weight"]
DESCRIBED += ["guidance_weight", "color_fits", "ema", "commit", "frame", "align", "fitted_to"]
"""Entries of the protocol that the note on a row states."""
MODE_COLUMNS = {
    "method": Heading("method", figures=False),
    "coverage": Heading("coverage ↑", form=".3f"),
    "total_variation": Heading("total variation ↓", form=".3f"),
    "mode_distance": Heading("mode distance ↓", form=".3f"),
    "rejected": Heading("rejected ↓", form=".3f"),
    "energy_hidden": Heading("energy hidden ↓", form=".4f"),
    "energy_visible": Heading("energy visible ↓", form=".4f"),
    "scenes": Heading("scenes", form="g"),
    "samples": Heading("samples", form="g"),
}
MODES_EXPLAINED = (
    "Coverage: share of the modes that samples hit. Total variation: of the samples' distribution from the true one. "
    "Mode distance: to the nearest mode over that of the modes' mean. Rejected: share of the samples. "
    "Energy: scores of the pixels that the reference hides, and of the others."
)

Measured = TypeVar("Measured")


def group_by_protocol(measurements: Iterable[tuple[Measured, Protocol]], *more: str) -> list[list[Measured]]:
    """Group measurements by equal protocols, in a fixed order; only scores within a group can be compared."""
    groups: dict[str, list[Measured]] = {}
    for measured, protocol in measurements:
        values: Mapping[str, object] = protocol
        compared = [values.get(name) for name in (*ALIKE, "data_fingerprint", "metrics", *more)]
        groups.setdefault(json.dumps(compared, sort_keys=True), []).append(measured)
    return [groups[key] for key in sorted(groups)]


def protocol_line(protocol: Protocol, keys: Sequence[str] = DESCRIBED) -> str:
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
    """Scores of one predictor in one run, or their means over the seeds of a sweep's setting.

    `deviations` are sample standard deviations over seeds. An upper bound has seen the views that it is scored on.
    `note` says how the scores were measured, and `lacking` why others are missing.
    """

    label: str
    scores: FlatScores
    scenes: int | str | None
    predictor: str = MODEL
    upper_bound: bool = False
    seeds: int | None = None
    steps: int | str | None = None
    deviations: FlatScores = field(default_factory=dict)
    protocol: Protocol = field(default_factory=Protocol)
    note: str = ""
    lacking: str = ""

    @property
    def ours(self) -> bool:
        """Whether the predictor is the run's model rather than a naive one."""
        return self.predictor in (MODEL, BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K)

    def cell(self, name: str, style: Style, notes: Notes, mark: str = UNMARKED) -> Cell:
        """Return a cell with the score `REGION_VIEW_METRIC`, or with the number of the note on why it is missing."""
        if (value := self.scores.get(name)) is not None or not self.lacking:
            return score_cell(style, value, self.deviations.get(name), mark)
        metric = metric_of(name)
        reason = self.protocol.get("missing", {}).get(metric, self.lacking)
        return Cell(f"missing: note {notes.number(f'{metric}: {reason}')}")

    def leading(self, notes: Notes) -> dict[str, Cell]:
        """Return the cells before the scores, by the keys of `LEADING`."""
        method = f"{self.label} [{notes.number(self.note)}]" if self.note else self.label
        cells = {"method": Cell(method), "resolution": Cell(str(self.protocol.get("resolution", ABSENT)))}
        cells |= {part: time_cell(self.scores.get(f"seconds_{part}")) for part in COST}
        counts = {"seeds": self.seeds, "scenes": self.scenes}
        return cells | {key: Cell("" if value is None else str(value)) for key, value in counts.items()}


def styles_of(entries: Sequence[Entry]) -> dict[str, Style]:
    """Return the styles of the metrics, the package's and then the user's own, which the entries' protocols state."""
    measured = [metric for entry in entries for metric in entry.protocol.get("metrics", {}).items()]
    return STYLES | {name: Style(**described["style"]) for name, described in measured if "style" in described}


def score_rows(
    entries: Sequence[Entry], keys: Sequence[str], columns: Sequence[tuple[str, str | None]], notes: Notes, marked: bool
) -> list[TableRow]:
    """Return a row for each entry: cells by keys of `LEADING`, then its scores.

    Naive predictors and upper bounds do not compete for the marks of the best and the second best.

    Args:
        columns: scores, each with the data set that it is of, or None for any.
        marked: whether to mark the best.
    """
    competing = [marked and entry.ours and not entry.upper_bound for entry in entries]
    metrics = styles_of(entries)
    styles = {name: metrics[metric_of(name)] for name, _ in columns}
    mark = {name: marks([entry.scores.get(name) for entry in entries], competing, x) for name, x in styles.items()}
    rows = []
    for index, entry in enumerate(entries):
        leading = entry.leading(notes)
        cells = [leading.get(key, Cell(ABSENT)) for key in keys]
        for name, data_set in columns:
            apart = data_set not in (None, entry.protocol.get("data_set"))
            cells.append(Cell(ABSENT) if apart else entry.cell(name, styles[name], notes, mark[name][index]))
        rows.append(TableRow("ours" if entry.ours else "naive", cells))
    return rows


def leading_headings(keys: Iterable[str]) -> list[Heading]:
    named = [(key, "time per sequence" if key in COST else "") for key in keys]
    return [Heading(LEADING[key], group, key not in ("method", "speed")) for key, group in named]


def entries_of(runs: Iterable[ResultsFile]) -> list[Entry]:
    return [_entry(run, predictor, scores) for run in runs for predictor, scores in run.entries.items()]


def _entry(run: ResultsFile, predictor: str, scores: FlatScores) -> Entry:
    protocol = run.protocol
    label = predictor.replace("_", " ")
    entry = Entry(label, scores, protocol["scenes"], predictor, bool(scores.get(UPPER_BOUND)), protocol=protocol)
    if entry.ours:
        samples = protocol.get("samples", 1)
        oracle = f", {samples}-best oracle by"
        criterion = str(protocol.get("criterion")).upper()
        kinds = {BEST_OF_K: f"{oracle} {criterion}", BEST_BY_METRIC: f"{oracle} each metric"}
        kinds[MEAN_OF_K] = f", mean of {samples} samples"
        kinds[MODEL] = ", single sample" if protocol.get("sampler") or samples != 1 else ""
        label = f"{protocol.get('method', 'model')}{kinds[predictor]}"
        label += " (upper bound)" if entry.upper_bound else ""
    owner = "" if entry.ours and protocol.get("frame") else OURS  # any program may have written the files
    note = f"{run.name}: {protocol_line(protocol)}."
    return replace(entry, label=f"{owner}{label}", note=note, lacking=f"not measured for {predictor}")


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
    groups = group_by_protocol((entry, entry.protocol) for entry in entries)
    return [_score_table(f"own_{index}", group) for index, group in enumerate(groups, 1)]


def _score_table(name: str, entries: Sequence[Entry]) -> Table:
    protocol = entries[0].protocol
    notes = Notes()
    # Our models first; a naive predictor has the same scores in all runs of a protocol, so it is shown once.
    naive: dict[object, Entry] = {}
    for entry in entries:
        scores = {key: value for key, value in entry.scores.items() if not key.startswith("seconds")}
        if not entry.ours:
            naive.setdefault((entry.predictor, *scores.items()), entry)
    selected = [*(entry for entry in entries if entry.ours), *naive.values()]
    styles = styles_of(selected)
    columns = [column for column in shown_scores(styles) if any(_known(entry, column) for entry in selected)]
    rows = score_rows(selected, OF_RUNS, [(column, None) for column in columns], notes, marked=True)
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = ["Ours, best in bold and second best underlined; not by the protocol of any published table."]
    remarks += [f"Measured alike in all rows. {SSIM_NOTE}", LEGEND]
    headings = [score_heading(column, styles[metric_of(column)]) for column in columns]
    return Table(name, title, [*leading_headings(OF_RUNS), *headings], rows, remarks, notes)


def _known(entry: Entry, column: str) -> bool:
    """Return whether an entry has the score of a column, or a stated reason for lacking it."""
    region, _, name = column.split("_", 2)
    stated = name in entry.protocol.get("missing", {}) and any(key.startswith(region) for key in entry.scores)
    return stated or column in entry.scores


def evaluation_table(results: Mapping[str, Mapping[str, object]], model: str = MODEL) -> Table:
    """Return a row for each predictor, PSNR in dB; object pixels only if there are masks.

    Args:
        results: the protocol (without it, metrics of the user's own are left out), and `Evaluation.results`.
        model: the label of the predictor that is the model.
    """
    protocol = results.get(PROTOCOL, {})
    measured = {name: x for name, x in results.items() if name != PROTOCOL}
    records = {model if name == MODEL else name: flat_scores(entry) for name, entry in measured.items()}
    first = next(iter(records.values()))
    entries = []
    for label, scores in records.items():
        bound = " (upper bound)" if scores.get(UPPER_BOUND) else ""
        entries.append(Entry(label + bound, scores, None, protocol=cast(Protocol, protocol)))
    styles = styles_of(entries)
    names = _evaluated(list(records.values()), shown_scores(styles))
    rows = score_rows(entries, ["method"], [(name, None) for name in names], Notes(), marked=False)
    headings = [Heading("predictor", figures=False)]
    for region, view, metric in (name.split("_", 2) for name in names):
        headings.append(Heading(f"{'all' if region == 'full' else region}\npixels\n{view}\n{styles[metric].heading}"))
    fitted = {label: entry.get("fitted_to") for label, entry in zip(records, measured.values(), strict=True)}
    remarks = [f"{label}: fitted to {views}." for label, views in fitted.items() if views]
    title = f"{counted(int(first['scenes']), 'scene')}, {counted(int(first['views']), 'novel view')}"
    return Table(title, title, headings, rows, [*remarks, SSIM_NOTE, SHARPNESS_NOTE])


def _evaluated(records: Sequence[FlatScores], names: Sequence[str]) -> list[str]:
    """Return those of the scores that are in the table, fewer than there are: more columns are too wide."""
    pairs = [(f"object_novel_{name}", f"full_novel_{name}") for name in ("psnr", "ssim")]
    masked = any(record.get(name) != record.get(whole) for record in records for name, whole in pairs)
    # Without masks, every pixel is the object's; with them, sharpness is the object's.
    of_objects = [name for name in names if name.startswith("object_")]
    apart = ["full_novel_sharpness", "object_novel_lpips"] if masked else of_objects
    return [name for name in names if name not in apart and any(name in record for record in records)]


def mode_tables(runs: Sequence[ResultsFile]) -> list[Table]:
    """Return a table for each protocol and number of samples."""
    groups = group_by_protocol(((run, run.protocol) for run in runs), "samples")
    return [_mode_table(f"hidden_modes_{index}", group) for index, group in enumerate(groups, 1)]


def _mode_table(name: str, runs: Sequence[ResultsFile]) -> Table:
    notes = Notes()
    records = dict[object, dict[str, object]]()
    for run in runs:
        note = notes.number(f"{run.name}: {protocol_line(run.protocol)}.")
        for method, scores in run.entries.items():
            ours = method == MODEL
            label = run.protocol.get("method", "model") if ours else method.replace("_", " ")
            record: dict[str, object] = {"source": "ours" if ours else "known", "method": f"{label} [{note}]", **scores}
            # Methods other than the model may have the same scores in several runs, and are then shown once.
            records.setdefault(run.name if ours else (label, *scores.items()), record)
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {protocol.get('data_fingerprint', 'unknown')[:12]}"
    columns = {key: value for key, value in MODE_COLUMNS.items() if any(key in each for each in records.values())}
    ordered = sorted(records.values(), key=lambda record: record["source"] != "ours")
    made = records_table(f"Hidden modes, {data}", ordered, columns)
    return replace(made, name=name, remarks=[MODES_EXPLAINED], notes=notes)
