"""Tables of our scores, one for each protocol, so that the rows of a table can be compared."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from completesplat.evaluation.records import (
    BEST_BY_METRIC,
    BEST_OF_K,
    MEAN_OF_K,
    MODEL,
    PROTOCOL,
    UPPER_BOUND,
    FlatScores,
    Protocol,
    ResultsFile,
    flat_scores,
)
from completesplat.evaluation.tables import (
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
    score_cell,
    score_heading,
    shown_scores,
)
from completesplat.metrics import METRIC_FORMATS, MetricFormat
from completesplat.wording import counted

OURS = "completesplat: "  # not "ours", because the paper gives its rows that name
COST = ("inference", "rendering")
LEADING = {
    "method": "method",
    "speed": "rendering speed",
    "inference": "inference",
    "rendering": "rendering",
    "seeds": "seeds",
    "scenes": "scenes",
    "resolution": "pixels",
}
"""The columns before the scores, and their headings."""
OF_RUNS = ["method", "inference", "rendering", "scenes", "resolution"]
"""Those of them in tables of single runs."""

ALIKE = [
    "name",
    "data_set",
    "subset",
    "split",
    "resolution",
    "crop",
    "background",
    "precision",
    "scenes",
    "skipped",
    "views",
    "protocol_views",
    "scene_list",
]
"""Entries of the protocol that are equal in all rows of a table, as are the data and the settings of the metrics."""
DESCRIBED = [
    *ALIKE,
    "image_size",
    "scenes_listed",
    "samples",
    "criterion",
    "seed",
    "sampler",
    "steps",
    "skip_weight",
    "guidance_weight",
    "color_fits",
    "ema",
    "commit",
    "frame",
    "align",
    "fitted_to",
]
"""Entries of the protocol that the note on a row states."""
Measured = TypeVar("Measured")


def group_by_protocol(measurements: Iterable[tuple[Measured, Protocol]], *more: str) -> list[list[Measured]]:
    """Group measurements by equal protocols, in a fixed order. Only scores within a group can be compared."""
    groups: dict[str, list[Measured]] = {}
    for measured, protocol in measurements:
        values: Mapping[str, object] = protocol
        compared = [values.get(name) for name in (*ALIKE, "data_fingerprint", "metrics", *more)]
        groups.setdefault(json.dumps(compared, sort_keys=True), []).append(measured)
    return [groups[key] for key in sorted(groups)]


def protocol_line(protocol: Protocol, keys: Sequence[str] = DESCRIBED) -> str:
    """Return the entries of the protocol as one line. With all of `DESCRIBED` it names the checkpoint as well."""
    values: Mapping[str, object] = protocol
    parts = []
    for key in keys:
        value = values.get(key)
        if value is not None:
            parts.append(f"{key} {len(value) if isinstance(value, list) else value}")
    if keys is DESCRIBED:
        checkpoint = protocol.get("checkpoint", {})
        parts += [f"checkpoint {key} {str(checkpoint[key])[:12]}" for key in ("step", "sha256") if checkpoint.get(key)]
    fingerprint = protocol.get("data_fingerprint")
    if fingerprint:
        parts.append(f"data {fingerprint[:12]}")
    machine = protocol.get("machine")
    if machine:
        parts.append(f"on {machine.get('gpu') or machine.get('processor')}, {machine.get('date')}")
    return ", ".join(parts)


@dataclass(frozen=True)
class Entry:
    """Scores of one predictor in one run, or their means over the seeds of a sweep's setting.

    `deviations` are sample standard deviations over seeds. An upper bound has seen the views that it is scored on.
    `note` says how the scores were measured, and `lacking` why others are missing. `unchanged` marks an ablation that
    changes nothing, and `bad_steps` counts the skipped steps of all seeds.
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
    unchanged: bool = False
    bad_steps: int = 0

    @property
    def ours(self) -> bool:
        """Whether the predictor is the run's model rather than a naive one."""
        return self.predictor in (MODEL, BEST_OF_K, BEST_BY_METRIC, MEAN_OF_K)

    def cell(self, name: str, metric_format: MetricFormat, notes: Notes, mark: str = UNMARKED) -> Cell:
        """Return a cell with the score `REGION_VIEW_METRIC`, or with the number of the note on why it is missing."""
        value = self.scores.get(name)
        if value is not None or not self.lacking:
            return score_cell(metric_format, value, self.deviations.get(name), mark)
        metric = metric_of(name)
        reason = self.protocol.get("missing", {}).get(metric, self.lacking)
        return Cell(f"missing: note {notes.number(f'{metric}: {reason}')}")

    def leading(self, notes: Notes) -> dict[str, Cell]:
        """Return the cells before the scores, by the keys of `LEADING`."""
        method = self.label
        if self.unchanged:
            method += " (changes nothing)"
        if self.bad_steps:
            method += f" ({counted(self.bad_steps, 'bad step')})"
        if self.note:
            method += f" [{notes.number(self.note)}]"
        return {
            "method": Cell(method),
            "inference": time_cell(self.scores.get("seconds_inference")),
            "rendering": time_cell(self.scores.get("seconds_rendering")),
            "seeds": _count_cell(self.seeds),
            "scenes": _count_cell(self.scenes),
            "resolution": Cell(str(self.protocol.get("resolution", ABSENT))),
        }


def _count_cell(count: int | str | None) -> Cell:
    return Cell("" if count is None else str(count))


def formats_of(entries: Sequence[Entry]) -> dict[str, MetricFormat]:
    """Return the formats of the package's metrics, then of the user's own, which the entries' protocols state."""
    formats = dict(METRIC_FORMATS)
    for entry in entries:
        for name, described in entry.protocol.get("metrics", {}).items():
            if "style" in described:
                formats[name] = MetricFormat(**described["style"])
    return formats


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
    by_metric = formats_of(entries)
    formats = {name: by_metric[metric_of(name)] for name, _ in columns}
    mark = {name: marks([entry.scores.get(name) for entry in entries], competing, x) for name, x in formats.items()}
    rows = []
    for index, entry in enumerate(entries):
        leading = entry.leading(notes)
        cells = [leading.get(key, Cell(ABSENT)) for key in keys]
        for name, data_set in columns:
            apart = data_set not in (None, entry.protocol.get("data_set"))
            cells.append(Cell(ABSENT) if apart else entry.cell(name, formats[name], notes, mark[name][index]))
        rows.append(TableRow("ours" if entry.ours else "naive", cells))
    return rows


def leading_headings(keys: Iterable[str]) -> list[Heading]:
    """Return the headings of columns of `LEADING`."""
    headings = []
    for key in keys:
        group = "time per sequence" if key in COST else ""
        headings.append(Heading(LEADING[key], group, figures=key not in ("method", "speed")))
    return headings


def entries_of(runs: Iterable[ResultsFile]) -> list[Entry]:
    """Return an entry for each predictor of each run."""
    return [_entry(run, predictor, scores) for run in runs for predictor, scores in run.entries.items()]


def _entry(run: ResultsFile, predictor: str, scores: FlatScores) -> Entry:
    protocol = run.protocol
    entry = Entry(
        predictor.replace("_", " "),
        scores,
        protocol["scenes"],
        predictor,
        upper_bound=bool(scores.get(UPPER_BOUND)),
        protocol=protocol,
        note=f"{run.name}: {protocol_line(protocol)}.",
        lacking=f"not measured for {predictor}",
    )
    if not entry.ours:
        return replace(entry, label=f"{OURS}{entry.label}")
    label = f"{protocol.get('method', 'model')}{_kind(predictor, protocol)}"
    if entry.upper_bound:
        label += " (upper bound)"
    # Any program may have written the scenes that are read from files.
    label = label if protocol.get("frame") else f"{OURS}{label}"
    return replace(entry, label=label, bad_steps=run.bad_steps, unchanged=run.unchanged)


def _kind(predictor: str, protocol: Protocol) -> str:
    """Return the clause of a row's label that says which of the model's samples it scores."""
    values: Mapping[str, object] = protocol
    samples = values.get("samples", 1)
    if predictor == BEST_OF_K:
        return f", {samples}-best oracle by {str(values.get('criterion')).upper()}"
    if predictor == BEST_BY_METRIC:
        return f", {samples}-best oracle by each metric"
    if predictor == MEAN_OF_K:
        return f", mean of {samples} samples"
    return ", single sample" if values.get("sampler") or samples != 1 else ""


def time_cell(seconds: float | None) -> Cell:
    """Return a time in the paper's units: `15.7 ms`, `2.7 sec`, `4.1 min`."""
    if seconds is None:
        return Cell(ABSENT)
    if seconds < 1:
        text = f"{1000 * seconds:.1f} ms"
    elif seconds < 60:
        text = f"{seconds:.1f} sec"
    else:
        text = f"{seconds / 60:.1f} min"
    return Cell(text, value=seconds)


def score_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each protocol, in the order of the protocols' names and of their data sets."""
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
    formats = formats_of(selected)
    columns = [column for column in shown_scores(formats) if any(_known(entry, column) for entry in selected)]
    rows = score_rows(selected, OF_RUNS, [(column, None) for column in columns], notes, marked=True)
    title = f"{protocol['data_set']}, {protocol.get('name', 'scores')}, {protocol['resolution']} pixels"
    remarks = [
        "Ours, best in bold and second best underlined; not by the protocol of any published table.",
        f"Measured alike in all rows. {SSIM_NOTE}",
        LEGEND,
    ]
    headings = [score_heading(column, formats[metric_of(column)]) for column in columns]
    return Table(name, title, [*leading_headings(OF_RUNS), *headings], rows, remarks, notes)


def _known(entry: Entry, column: str) -> bool:
    """Return whether an entry has the score of a column, or a stated reason for lacking it."""
    region, _, name = column.split("_", 2)
    stated = name in entry.protocol.get("missing", {}) and any(key.startswith(region) for key in entry.scores)
    return stated or column in entry.scores


def evaluation_table(results: Mapping[str, Mapping[str, object]], model: str = MODEL) -> Table:
    """Return a row for each predictor, PSNR in dB, and object pixels only if there are masks.

    Args:
        results: the protocol (without it, metrics of the user's own are left out), and `SceneScores.results`.
        model: the label of the predictor that is the model.
    """
    protocol = cast(Protocol, results.get(PROTOCOL, {}))
    entries = []
    remarks = []
    for name, measured in results.items():
        if name == PROTOCOL:
            continue
        label = model if name == MODEL else name
        scores = flat_scores(measured)
        bound = " (upper bound)" if scores.get(UPPER_BOUND) else ""
        entries.append(Entry(label + bound, scores, None, protocol=protocol))
        if measured.get("fitted_to"):
            remarks.append(f"{label}: fitted to {measured['fitted_to']}.")
    formats = formats_of(entries)
    names = _evaluated([entry.scores for entry in entries], shown_scores(formats))
    rows = score_rows(entries, ["method"], [(name, None) for name in names], Notes(), marked=False)
    headings = [Heading("predictor", figures=False)]
    for region, view, metric in (name.split("_", 2) for name in names):
        pixels = "all" if region == "full" else region
        headings.append(Heading(f"{pixels}\npixels\n{view}\n{formats[metric].heading}"))
    first = entries[0].scores
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
