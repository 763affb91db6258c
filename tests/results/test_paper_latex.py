"""The typed figures against LaTeX: of the paper where it is at hand, of a small table of the same form always."""

import os
from pathlib import Path

import pytest
from paper_latex import check, differences, figure

from completesplat.results.published import PrintedColumn, PublishedTable, parse, published

PAPER = os.environ.get("COMPLETESPLAT_PAPER")
SMALL = r"""
\begin{table} \label{other} \begin{tabular}{l} \toprule x \\ \end{tabular} \end{table}
\begin{table*}
    \resizebox{1.0\linewidth}{!}{
    \begin{tabular}{@{}clcc@{}}
        \toprule % a remark with & and \\
        \textbf{Rendering} & \multirow{2}{*}{\textbf{Methods}} & \multicolumn{2}{c}{\textbf{Apples}} \\
        \cmidrule(l){3-4}
        \textbf{Speed} & & \textbf{PSNR ↑} & \textbf{\# LPIPS ↓} \\ \midrule
        \multirow{2}{*}{Slow} & One~\cite{one} $\dagger$ & \textbf{17.90} & 0.54 \\
         & Two \cite{two} & - & \\
        \cmidrule(l){2-4}
        \cmidrule(l){2-4}
        \rowcolor[HTML]{EFEFEF} & Three $\star$ & {\ul 17.4} & {\bf 0.4} \\
        \rowcolor[HTML]{EFEFEF} \multirow{-2}{*}{Fast} & \cellcolor[HTML]{EFEFEF}Four & \underline{17.4}
          & { 0.40} \\ \hline
    \end{tabular} }
    \caption{$\dagger$: cited   from
      \cite{one}.}
    \label{small}
\end{table*}
"""
ROWS = """Slow | One dagger | 17.90 best | 0.54
Slow | Two | - |
Fast | Three star | 17.4 second | 0.4 best
Fast | Four | 17.4 second | 0.40"""
HEADINGS = {"Rendering Speed": "speed", "Methods": "method", "Apples PSNR ↑": "psnr", "Apples # LPIPS ↓": "lpips"}


def table(rows: str = ROWS, label: str = "small", says: str = r"$\dagger$: cited from \cite{one}") -> PublishedTable:
    columns = [PrintedColumn(heading, key, "") for heading, key in HEADINGS.items()]
    cells = [[parse(cell) for cell in line.split("|")] for line in rows.splitlines()]
    return PublishedTable("small", "Table 1", label, "", "full", "novel", [], [says], columns, cells, {})


@pytest.mark.skipif(PAPER is None, reason="COMPLETESPLAT_PAPER does not name the LaTeX of the paper")
def test_the_published_figures_are_typed_as_the_paper_prints_them() -> None:
    assert check(Path(PAPER or "").read_text(encoding="utf-8")) == []


def test_a_table_typed_as_printed_has_no_differences() -> None:
    assert differences(table(), SMALL) == []


@pytest.mark.parametrize(
    ("typed", "wrong", "said"),
    [
        ("17.90 best", "17.9 best", "Slow / One, Apples PSNR ↑: '17.9' best, the paper prints '17.90' best"),
        ("One dagger", "One", "Methods: 'One', the paper prints 'One' dagger"),
        ("Two | - |", "Two | - | -", "Apples # LPIPS ↓: '-', the paper prints ''"),
        ("Fast | Three", "Slow | Three", "Rendering Speed: 'Slow', the paper prints 'Fast'"),
        ("Fast | Four | 17.4 second | 0.40", "Fast | Four | 17.4 second", "3 cells, the paper has 4"),
        ("\nFast | Four | 17.4 second | 0.40", "", "3 rows, the paper has 4"),
    ],
)
def test_every_difference_is_found(typed, wrong, said) -> None:
    assert typed in ROWS
    (found,) = differences(table(ROWS.replace(typed, wrong)), SMALL)
    assert said in found


def test_another_heading_phrase_or_table_and_a_table_without_headings_are_differences() -> None:
    (found,) = differences(table(), SMALL.replace("Apples", "Pears"))
    assert "Pears PSNR" in found
    assert differences(table(says="in inches"), SMALL) == ["small: the paper does not say 'in inches'"]
    assert differences(table(label="nowhere"), SMALL) == ["small: the paper has no table labelled nowhere"]
    assert differences(table(label="other", says="x"), SMALL) == ["small: no heading with PSNR"]


def test_a_paper_without_tables_differs_in_all() -> None:
    assert len(check("")) == len(published())


@pytest.mark.parametrize(
    ("latex", "typed"),
    [
        (r"{\ul 0.25}", "0.25 second"),
        (r"{\bf 0.477} ", "0.477 best"),
        (r"\underline{0.111}", "0.111 second"),
        (r" A~\cite{a, b} $\dagger$", "A dagger"),
        (r"\# 6,473", "# 6,473"),
    ],
)
def test_a_cell_is_read_as_it_is_typed(latex, typed) -> None:
    assert figure(latex) == parse(typed)


def test_every_table_is_complete() -> None:
    for known in published():
        assert all(len(row) == len(known.columns) for row in known.rows)
        assert all(column.data_set for column in known.columns if column.key in ("psnr", "lpips", "fid", "kid"))
        signs = {mark for row in known.rows for cell in row for mark in cell.marks} & {"dagger", "star"}
        assert signs == set(known.legend)
    places = [known.place for known in published()]
    assert len(set(places)) == len(places) == 4


def test_the_protocols_of_the_tables_are_there() -> None:
    from completesplat.commands import conf_folder

    there = {path.stem for path in (conf_folder() / "evaluation").glob("*.yaml")}
    assert {name for known in published() for name in known.evaluations} <= there


def test_every_ablation_that_a_sweep_can_name_is_a_row() -> None:
    from completesplat.commands import conf_folder

    (ablations,) = (known for known in published() if known.options)
    assert set(ablations.options.values()) == {row[0].text for row in ablations.rows}
    named = {path.stem for folder in ("ablation", "model") for path in (conf_folder() / folder).glob("*.yaml")}
    assert set(ablations.options) <= named
    assert {path.stem for path in (conf_folder() / "ablation").glob("*.yaml")} <= set(ablations.options)
