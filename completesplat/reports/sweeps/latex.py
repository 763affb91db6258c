"""The table as LaTeX, with booktabs' rules."""

from itertools import groupby
from typing import Any

from completesplat.reports.sweeps.headline import BEST, SECOND, UNMARKED, columns, figure, group, marks, metric
from completesplat.reports.sweeps.summary import CAPTION, NOTHING, Summary

MARKED = {BEST: r"\textbf{%s}", SECOND: r"\underline{%s}", UNMARKED: "%s"}
ESCAPES = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
    | {"±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}
)


def latex(summary: Summary) -> str:
    """A `table` with the headline columns, best in bold and second best underlined, and the remarks below."""
    table = _tabular(summary) if summary.rows else [escape(NOTHING)]
    remarks = [escape(f"{remark} ") + r"\par" for remark in (CAPTION, *summary.remarks)]
    commands = [rf"\texttt{{{escape(command)}}}\par" for command in summary.commands]
    below = [r"\par\smallskip\footnotesize\raggedright", *remarks, *commands]
    lines = [r"% \usepackage{booktabs}", r"\begin{table}", r"\centering", *table, *below, r"\end{table}"]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Text as LaTeX prints it literally."""
    return text.translate(ESCAPES)


def _tabular(summary: Summary) -> list[str]:
    shown = columns(summary.rows)
    marked = {column: marks(summary.rows, column) for column in shown}
    groups = [(name, len(list(members))) for name, members in groupby(shown, key=group)]
    above = " & ".join(rf"\multicolumn{{{count}}}{{c}}{{{escape(name)}}}" for name, count in groups)
    heading = " & ".join(["ablation", "seeds", "scenes", *(escape(metric(column)) for column in shown)])
    lines = [rf"\begin{{tabular}}{{l{'r' * (2 + len(shown))}}}", r"\toprule"]
    lines += [rf"& & & {above} \\", rf"{heading} \\", r"\midrule"]
    for index, row in enumerate(summary.rows):
        if index and row["seeds"] is None and summary.rows[index - 1]["seeds"] is not None:
            lines.append(r"\midrule")  # the naive predictors, below our own
        figures = [_marked(figure(row, column), marked[column][index]) for column in shown]
        lines.append(" & ".join([*_identity(row), *figures]) + r" \\")
    return [*lines, r"\bottomrule", r"\end{tabular}"]


def _identity(row: dict[str, Any]) -> list[str]:
    return [escape("" if row[key] is None else str(row[key])) for key in ("ablation", "seeds", "scenes")]


def _marked(text: str, mark: str) -> str:
    return MARKED[mark] % escape(text)
