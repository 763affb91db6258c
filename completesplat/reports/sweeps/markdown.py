"""The table as Markdown."""

from collections.abc import Sequence

from completesplat.reports.sweeps.headline import BEST, SECOND, UNMARKED, columns, figure, group, marks, metric
from completesplat.reports.sweeps.summary import CAPTION, NOTHING, Summary

MARKED = {BEST: "**{}**", SECOND: "<ins>{}</ins>", UNMARKED: "{}"}


def markdown(summary: Summary) -> str:
    """The headline columns, best in bold and second best underlined, with the remarks below."""
    table = "\n".join(_table(summary)) if summary.rows else NOTHING
    remarks = "\n".join(f"- {remark}" for remark in summary.remarks)
    commands = "```\n" + "\n".join(summary.commands) + "\n```\n" if summary.commands else ""
    return f"{table}\n\n{CAPTION}\n\n{remarks}\n\n{commands}".rstrip() + "\n"


def _table(summary: Summary) -> list[str]:
    shown = columns(summary.rows)
    marked = {column: marks(summary.rows, column) for column in shown}
    lines = [
        _line(["ablation", "seeds", "scenes", *(f"{group(column)}: {metric(column)}" for column in shown)]),
        _line(["---", *["---:"] * (2 + len(shown))]),
    ]
    for index, row in enumerate(summary.rows):
        figures = [MARKED[marked[column][index]].format(figure(row, column)) for column in shown]
        counts = ["" if row[key] is None else str(row[key]) for key in ("seeds", "scenes")]
        lines.append(_line([row["ablation"].replace("|", r"\|"), *counts, *figures]))
    return lines


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
