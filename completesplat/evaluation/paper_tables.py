"""Tables of the paper, with our runs beside them if they were measured by the same protocol."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.evaluation import score_tables, tables
from completesplat.evaluation.mode_tables import mode_tables
from completesplat.evaluation.records import BEST_BY_METRIC, BEST_OF_K, HOW, MODES, SCORES, RunTree
from completesplat.evaluation.sweep_jobs import Job, collect
from completesplat.evaluation.sweep_summary import sweep_rows
from completesplat.wording import printable

FILE = Path(__file__).with_suffix(".yaml")
PAPER = "Liao et al., Complete Gaussian Splats from a Single Image with Denoising Diffusion Models, 3DV 2026"
METRICS = ("psnr", "lpips", "fid", "kid")

SIGNS = {"dagger": "†", "star": "★"}
VIEWS = (
    "The paper names both reference and novel views in its protocol and does not say how it weighs them; "
    "our rows are of novel views."
)
LACKING = "not measured in all jobs of this row"
APART = "Rows of ours are by the protocol in their note, not by the paper's: they compare among each other only."


PublishedTable = Any
"""Table of the paper and the protocol of its figures: an entry of `paper_tables.yaml`, whose head explains its keys."""


@cache
def read_tables() -> list[PublishedTable]:
    """Return all tables, in the paper's order."""
    return list(OmegaConf.load(FILE).tables)


def printed_rows(table: PublishedTable) -> list[list[tables.Cell]]:
    """Return the cells of a table's rows."""
    return [[parse_cell(cell) for cell in line.split("|")] for line in table.rows.splitlines()]


def score_columns(table: PublishedTable) -> list[tuple[int, Any, str]]:
    """Return number, column and data set of each column of scores."""
    columns = []
    for number, column in enumerate(table.columns):
        if column.key in METRICS:
            columns.append((number, column, column.get("data_set", table.get("data_set"))))
    return columns


def parse_cell(cell: str) -> tables.Cell:
    """Convert `17.93 best` to the text `17.93` with the mark `best`. Dagger and star become signs behind the text."""
    words = cell.split()
    text = " ".join(word for word in words if word not in (tables.BEST, tables.SECOND, *SIGNS)) or tables.BLANK
    signs = [SIGNS[word] for word in words if word in SIGNS]
    mark = next((word for word in words if word in (tables.BEST, tables.SECOND)), tables.UNMARKED)
    return tables.Cell(" ".join([text, *signs]), mark)


def comparison_table(table: PublishedTable, entries: Sequence[score_tables.Entry]) -> tables.Table:
    """Return the published rows, followed by entries of ours.

    Times are of one sequence, warm, for the complete pipeline.
    """
    notes = tables.Notes()
    keys = ["method"]
    is_ablation = bool(table.get("options"))
    if not is_ablation:
        columns = {*score_tables.OF_RUNS, *(column.key for column in table.columns)}
        keys = [key for key in score_tables.LEADING if key in columns]
    scored = score_columns(table)
    names = [f"{table.region}_{table.view}_{column.key}" for _, column, _ in scored]
    data_sets = [None if is_ablation else data_set for *_, data_set in scored]
    ours = score_tables.score_rows(entries, keys, list(zip(names, data_sets, strict=True)), notes, marked=False)
    headings = score_tables.leading_headings(keys)
    headings += [tables.Heading(column.heading) for _, column, _ in scored]
    rows = [*_published_rows(table, keys), *ours]
    remarks = _remarks(table, bool(entries))
    return tables.Table(table.name, f"{table.place}: {table.title}", headings, rows, remarks, notes)


def _remarks(table: PublishedTable, with_ours: bool) -> list[str]:
    remarks = [f"Published figures: {PAPER}, {table.place}; best in bold and second best underlined as printed."]
    remarks += [f"{SIGNS[mark]}: {meaning}." for mark, meaning in table.get("legend", {}).items()]
    remarks.append(tables.LEGEND)
    if not table.get("options"):
        remarks.append(VIEWS)
    elif with_ours:
        remarks.append(APART)
    return [*remarks, *table.get("remarks", [])]


def _published_rows(table: PublishedTable, keys: Sequence[str]) -> list[tables.TableRow]:
    """Return the paper's rows: first the cells of `keys`, then the scores."""
    rows = []
    absent = tables.Cell(tables.ABSENT)
    for row in printed_rows(table):
        cells = {"resolution": tables.Cell(table.get("resolution", tables.ABSENT))}
        cells |= {column.key: cell for column, cell in zip(table.columns, row, strict=True)}
        leading = [cells.get(key, absent) for key in keys]
        scores = [row[number] for number, _, _ in score_columns(table)]
        rows.append(tables.TableRow("paper", [*leading, *scores]))
    return rows


def is_comparable(table: PublishedTable, entry: score_tables.Entry) -> bool:
    """Return whether an entry was measured like the table's figures.

    The run followed one of the table's evaluations: the same views, resolution and number of scenes (all scenes of the
    list where the table states no number), on one of the table's data sets and on its list of sequences, with no scene
    skipped, with skip connections at full weight, and on all pixels. A best of k belongs to a table whose best of k has
    the same k. A model that has seen the views that it is scored on belongs to no table.
    """
    protocol: Mapping[str, Any] = entry.protocol
    wanted = table.evaluations.get(str(protocol.get("name")))
    if wanted is None:
        return False
    is_oracle = entry.predictor in (BEST_OF_K, BEST_BY_METRIC)
    differences = (
        entry.upper_bound,
        protocol.get("skipped"),
        protocol.get("background") is not None,
        protocol.get("skip_weight") not in (None, 1),
        protocol["data_set"] not in {data_set for *_, data_set in score_columns(table)},
        "subset" in table and protocol.get("subset") != table.subset,
        is_oracle and protocol.get("samples") != table.get("oracle_samples"),
        protocol["scenes"] not in wanted.get("scenes", [protocol.get("scenes_listed")]),
        protocol["resolution"] != wanted["resolution"],
        protocol.get("protocol_views") != wanted["protocol_views"],
    )
    return not any(differences)


def sweep_entries(table: PublishedTable, name: str, jobs: Sequence[Job]) -> list[score_tables.Entry]:
    """Return a sweep's means over seeds by protocol, with the paper's names of their settings."""
    entries = []
    for group in score_tables.group_by_protocol((job, job.protocol) for job in jobs):
        protocol = group[0].protocol
        shared = score_tables.protocol_line(protocol, score_tables.ALIKE)
        note = f"{name}: mean ± sample deviation over seeds; {shared}."
        for row in sweep_rows(group):
            label = f"{score_tables.OURS}{row.label}"
            label += "".join(f" ({table.options[part]})" for part in row.label.split(", ") if part in table.options)
            if row.seeds:
                label += f", {row.seeds} seeds"
            entries.append(replace(row, label=label, note=note, protocol=protocol, lacking=LACKING))
    return entries


def published_tables(tree: RunTree | None) -> list[tables.Table]:
    """Return the published tables with the runs below a folder, or the published figures alone for None.

    A run is listed below published rows only if it was measured like them, else in a table for its protocol. The jobs
    of a sweep over ablations are listed in the ablation tables alone.

    Raises:
        CompleteSplatError: there are no results.
    """
    if tree is None:
        return [comparison_table(table, []) for table in read_tables()]
    if not (tree.scores or tree.modes or tree.warnings):
        raise CompleteSplatError(f"runs={tree.folder}: no {SCORES} and no {MODES} in it or below it; {HOW}")
    sweeps = _ablation_sweeps(tree)
    listed = {folder / job.name for folder, tested in sweeps.items() for job in tested}
    single = score_tables.entries_of(run for run in tree.scores if run.folder not in listed)
    made = []
    placed = []
    for table in read_tables():
        entries = []
        if table.get("options"):
            for folder, tested in sweeps.items():
                entries += sweep_entries(table, printable(folder.relative_to(tree.folder).as_posix()), tested)
        else:
            entries = [entry for entry in single if is_comparable(table, entry)]
            placed += entries
        made.append(comparison_table(table, entries))
    others = score_tables.score_tables([entry for entry in single if entry not in placed])
    return [*made, *others, *mode_tables(tree.modes)]


def _ablation_sweeps(tree: RunTree) -> dict[Path, list[Job]]:
    """Return the tested jobs of each sweep over ablations, with a published row or without, by the sweep's folder."""
    options = {option for table in read_tables() for option in table.get("options", [])}
    sweeps = {}
    for folder in tree.sweeps:
        tested = [job for job in collect(folder) if job.protocol]
        if any({*options, job.overrides.get("ablation")} & set(job.label.split(", ")) for job in tested):
            sweeps[folder] = tested
    return sweeps
