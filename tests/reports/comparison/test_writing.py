"""The tables as files."""

import csv
import re

import pytest

from completesplat.results.published import published, tables
from completesplat.results.tables import Cell, Heading, Row, Table, as_latex, as_markdown, show_tables, write_tables

ENVIRONMENT = re.compile(r"\\(begin|end)\{(\w+\*?)\}")


@pytest.fixture
def written(runs, run, tmp_path):
    whole = {"subset": "fewview_dev", "scenes_listed": 20}
    run("a", 17.123456, name="co3d", data_set="co3d/hydrant", resolution=128, **whole)
    run("b_100%", 20.0)
    found = tables(runs)[0]
    write_tables(found, tmp_path / "out")
    return found, tmp_path / "out"


def rows_of_latex(text: str) -> list[str]:
    """The rows of all tabulars."""
    bodies = re.findall(r"\\begin\{tabular\}\{\w+\}(.*?)\\end\{tabular\}", text, re.DOTALL)
    return [line for body in bodies for line in body.splitlines() if line.endswith(r"\\")]


def width(row: str) -> int:
    """Columns that a row of LaTeX fills."""
    cells = re.split(r"(?<!\\)&", row)
    spans = [re.search(r"\\multicolumn\{(\d+)\}", cell) for cell in cells]
    return sum(int(span.group(1)) if span else 1 for span in spans)


def test_latex_is_balanced_and_all_rows_have_the_columns_of_their_table(written) -> None:
    found, out = written
    text = (out / "tables.tex").read_text()
    opened: list[str] = []
    for kind, name in ENVIRONMENT.findall(text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    assert len(re.findall(r"(?<!\\)\{", text)) == len(re.findall(r"(?<!\\)\}", text))
    for table in found:
        latex = as_latex(table)
        (columns,) = re.findall(r"\\begin\{tabular\}\{(\w+)\}", latex)
        assert {width(row) for row in rows_of_latex(latex)} == {len(columns)} == {len(table.headings)}
    uncommented = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert re.findall(r"(?<!\\)[%#](?!$)", uncommented, re.MULTILINE) == []
    assert not set(re.sub(r"[\x00-\x7f]", "", text))  # no character that needs more than plain LaTeX


def test_the_published_figures_are_in_all_files_as_printed(written) -> None:
    _, out = written
    markdown, latex = (out / "tables.md").read_text(), (out / "tables.tex").read_text()
    with (out / "tables.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    for table in published():
        texts = {line["text"] for line in lines if line["table"] == table.name and line["source"] == "paper"}
        for cell in (cell for row in table.rows for cell in row if cell.text):
            assert cell.text in markdown
            assert cell.text in latex
            assert any(text.startswith(cell.text) for text in texts)
    assert "| **17.93** | 0.54 | 180.20 | 0.14 |" in markdown
    assert "PixelNeRF †" in markdown
    assert r"PixelNeRF $\dagger$ & Offline & 5.0 sec" in latex
    assert r"\underline{17.59}" in latex


def test_the_csv_holds_all_digits_of_ours_and_a_line_for_each_cell(written) -> None:
    found, out = written
    with (out / "tables.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == sum(len(table.rows) * len(table.headings) for table in found)
    assert all(line["text"] for line in lines)
    (line,) = (line for line in lines if line["text"] == "17.12")
    assert (float(line["value"]), line["table"], line["column"]) == (17.123456, "full_images", "Hydrants PSNR ↑")


def test_markdown_has_as_many_cells_in_each_line(written) -> None:
    for table in written[0]:
        lines = [line for line in as_markdown(table).splitlines() if line.startswith("|")]
        assert {len(re.split(r"(?<!\\)\|", line)) - 2 for line in lines} == {len(table.headings)}


def test_everything_is_printed(written, capsys) -> None:
    show_tables(written[0])
    printed = capsys.readouterr().out
    for table in written[0]:
        assert table.title in printed
        assert all(line[:40] in printed for line in table.below())


def test_an_empty_cell_is_refused() -> None:
    with pytest.raises(ValueError, match="in 1 columns"):
        Table("x", "X", [Heading("a")], [Row("ours", [Cell("")])], [])
