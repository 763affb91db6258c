"""Tables of tests on hidden modes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from completesplat.evaluation.records import MODEL, ResultsFile
from completesplat.evaluation.score_tables import group_by_protocol, protocol_line
from completesplat.evaluation.tables import Heading, Notes, Table, records_table

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


def mode_results_table(results: Mapping[str, Mapping[str, object]], model: str = MODEL) -> Table:
    """Return a row for each method of one test on hidden modes. `model` is the label of the tested one."""
    title = "Hidden modes (best: coverage 1, the others 0; draws of the truth: true_sampler)"
    records = [{"method": model if name == MODEL else name, **scores} for name, scores in results.items()]
    return records_table(title, records, MODE_COLUMNS)


def mode_tables(runs: Sequence[ResultsFile]) -> list[Table]:
    """Return a table for each protocol and number of samples."""
    groups = group_by_protocol(((run, run.protocol) for run in runs), "samples")
    return [_mode_table(f"hidden_modes_{index}", group) for index, group in enumerate(groups, 1)]


def _mode_table(name: str, runs: Sequence[ResultsFile]) -> Table:
    notes = Notes()
    records: dict[object, dict[str, object]] = {}
    for run in runs:
        note = notes.number(f"{run.name}: {protocol_line(run.protocol)}.")
        for method, scores in run.entries.items():
            if method == MODEL:
                label = run.protocol.get("method", "model")
                records[run.name] = {"source": "ours", "method": f"{label} [{note}]", **scores}
            else:
                # Methods other than the model may have the same scores in several runs, and are then shown once.
                label = method.replace("_", " ")
                known = {"source": "known", "method": f"{label} [{note}]", **scores}
                records.setdefault((label, *scores.items()), known)
    protocol = runs[0].protocol
    data = protocol.get("data_set") or f"data {protocol.get('data_fingerprint', 'unknown')[:12]}"
    columns = {key: value for key, value in MODE_COLUMNS.items() if any(key in each for each in records.values())}
    ordered = sorted(records.values(), key=lambda record: record["source"] != "ours")
    made = records_table(f"Hidden modes, {data}", ordered, columns)
    return replace(made, name=name, remarks=[MODES_EXPLAINED], notes=notes)
