"""All tables of a report."""

from pathlib import Path

from completesplat.reports.comparison.ablations import is_ablation, published_ablations, sweep_beside
from completesplat.reports.comparison.beside import belongs, beside
from completesplat.reports.comparison.cells import Table
from completesplat.reports.comparison.entries import entries
from completesplat.reports.comparison.modes import mode_tables
from completesplat.reports.comparison.own import own_tables
from completesplat.reports.comparison.runs import find
from completesplat.reports.published.figures import published


def tables(folder: Path | None) -> tuple[list[Table], list[str]]:
    """The published tables with the runs below a folder, and warnings about files that were left out.

    A run stands below published rows only if it was measured like them, else in a table of its own protocol. The jobs
    of a sweep over ablations stand in the ablation tables alone. Without a folder: the published figures.

    Raises:
        CompleteSplatError: there is no such folder, or no results in it.
    """
    if folder is None:
        return [beside(table, []) if not table.options else published_ablations(table) for table in published()], []
    found = find(folder)
    (ablations,) = (table for table in published() if table.options)
    sweeps = [sweep for sweep in found.sweeps if is_ablation(sweep, ablations)]
    inside = {str(sweep.relative_to(folder)) for sweep in sweeps}
    single = entries([run for run in found.scores if str(Path(run.name).parent) not in inside])
    made: list[Table] = []
    for table in published():
        if table.options:
            compared = [t for sweep in sweeps for t in sweep_beside(table, sweep, str(sweep.relative_to(folder)))]
            made += compared or [published_ablations(table)]
        else:
            made.append(beside(table, single))
    placed = [entry for entry in single if any(belongs(table, entry) for table in published() if not table.options)]
    elsewhere = [entry for entry in single if not any(entry is other for other in placed)]
    return [*made, *own_tables(elsewhere), *mode_tables(found.modes)], found.warnings
