"""The one type of table, as files and on the terminal."""

import csv
import re

import pytest

from completesplat.evaluation import table_writers, tables
from completesplat.evaluation.paper_tables import printed_rows, published_tables, read_tables
from completesplat.evaluation.records import find_results
from completesplat.evaluation.score_tables import evaluation_table


@pytest.fixture
def written(runs, run, tmp_path):
    whole = {"subset": "fewview_dev", "scenes_listed": 20}
    whole |= {"protocol_views": "reference: a sequence's first frame; targets: its other frames"}
    run("a", 17.123456, name="co3d", data_set="co3d/hydrant", resolution=128, **whole)
    run("b_100%|", 20.0)
    made = published_tables(find_results(runs))
    table_writers.write_tables(made, tmp_path / "out")
    return made, tmp_path / "out"


def rows_of_latex(text: str) -> list[str]:
    bodies = re.findall(r"\\begin\{tabular\}\{\w+\}(.*?)\\end\{tabular\}", text, re.DOTALL)
    return [line for body in bodies for line in body.splitlines() if line.endswith(r"\\")]


def width(row: str) -> int:
    """Columns that a row of LaTeX fills."""
    cells = re.split(r"(?<!\\)&", row)
    spans = [re.search(r"\\multicolumn\{(\d+)\}", cell) for cell in cells]
    return sum(int(span.group(1)) if span else 1 for span in spans)


def test_latex_is_balanced_and_all_rows_have_the_columns_of_their_table(written) -> None:
    made, out = written
    text = (out / "tables.tex").read_text()
    opened: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    assert len(re.findall(r"(?<!\\)\{", text)) == len(re.findall(r"(?<!\\)\}", text))
    for each in made:
        latex = table_writers.as_latex(each)
        (columns,) = re.findall(r"\\begin\{tabular\}\{(\w+)\}", latex)
        assert {width(row) for row in rows_of_latex(latex)} == {len(columns)} == {len(each.headings)}
        lines = [line for line in table_writers.as_markdown(each).splitlines() if line.startswith("|")]
        assert {len(re.split(r"(?<!\\)\|", line)) - 2 for line in lines} == {len(each.headings)}
    uncommented = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert re.findall(r"(?<!\\)[%#](?!$)", uncommented, re.MULTILINE) == []
    assert text.isascii()


def test_bars_in_headings_and_cells_make_no_columns_in_markdown() -> None:
    row = tables.TableRow("ours", [tables.Cell("1|2")])
    made = tables.Table("name", "title", [tables.Heading("|error|")], [row], [])
    assert table_writers.as_markdown(made).splitlines()[2:5] == [r"| \|error\| |", "| ---: |", r"| 1\|2 |"]


def test_all_files_have_the_published_figures_as_printed_and_the_csv_all_digits_of_ours(written, capsys) -> None:
    made, out = written
    markdown, latex = (out / "tables.md").read_text(), (out / "tables.tex").read_text()
    with (out / "tables.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    for known in read_tables():
        texts = {line["text"] for line in lines if line["table"] == known.name and line["source"] == "paper"}
        for cell in (cell for row in printed_rows(known) for cell in row):
            assert cell.text in markdown
            assert table_writers.escape(cell.text) in latex
            assert cell.text in texts or cell.text == tables.BLANK
    assert "| **17.93** | 0.54 | 180.20 | 0.14 |" in markdown
    assert r"PixelNeRF $\dagger$ & Offline & 5.0 sec" in latex
    assert r"\underline{17.59}" in latex
    assert len(lines) == sum(len(each.rows) * len(each.headings) for each in made)
    assert all(line["text"] for line in lines)
    (line,) = (line for line in lines if line["text"] == "17.12")
    assert (float(line["value"]), line["table"], line["column"]) == (17.123456, "full_images", "Hydrants PSNR ↑")
    table_writers.show(*made, width=240)
    printed = capsys.readouterr().out
    for each in made:
        assert all(line[:40] in printed for line in (each.title, *each.below()))


def test_latex_prints_special_characters_literally() -> None:
    assert (
        table_writers.escape(r"a_b 50% & #1 {$c} a\b 1 ± 2") == r"a\_b 50\% \& \#1 \{\$c\} a\textbackslash{}b 1 $\pm$ 2"
    )
    assert table_writers.escape("x^2~y") == r"x\textasciicircum{}2\textasciitilde{}y"


def test_missing_entries_of_records_stay_empty(capsys) -> None:
    columns = {"name": tables.Heading("name", figures=False), "figure": tables.Heading("figure", form=".1f")}
    shown = tables.records_table("Title", [{"name": "[red]"}, {"figure": 1.25}], columns)
    assert [[cell.text for cell in row.cells] for row in shown.rows] == [["[red]", ""], ["", "1.2"]]
    table_writers.show(shown)
    assert "[red]" in capsys.readouterr().out


def test_an_evaluation_shows_every_predictor_with_all_digits_in_any_width(capsys) -> None:
    views = {"psnr": 20.0, "ssim": 0.5, "lpips": 0.125, "fid": 101.25, "kid": 0.0123, "sharpness": 0.6225}
    entry = {"scenes": 2, "views": 4, "full": {"novel": views, "reference": views}, "seconds": {"inference": 7.0}}
    entry["object"] = {"novel": views | {"psnr": 24.0}, "reference": views}
    table_writers.show(evaluation_table({"model": entry, "mirrored_reference": entry}), width=160)
    printed = capsys.readouterr().out
    assert "2 scenes, 4 novel views" in printed
    assert all(
        text in printed for text in ("20.00", "24.00", "object", "0.500", "0.125", "101.2", "0.0123", tables.SSIM_NOTE)
    )
    assert printed.count("0.62 ") == 2  # of object pixels
    assert "mirrored_reference" in printed
    assert tables.SHARPNESS_NOTE in printed
    assert "…" not in printed


@pytest.mark.parametrize("width", [60, 80, 120, 240])
def test_tables_break_no_word_in_any_width_and_show_all_columns(runs, run, capsys, width) -> None:
    run("a", 20.0, {"copy_reference": 10.0})
    for table in published_tables(find_results(runs)):
        table_writers.show(table, width=width)
        printed = capsys.readouterr().out
        assert max(map(len, printed.splitlines()[: -len(table.below())])) <= width
        shown = set(re.split(r"[\s│┃]+", printed))
        texts = [heading.joined(" ") for heading in table.headings] + [x.text for row in table.rows for x in row.cells]
        assert {word for text in texts for word in text.split()} <= shown


def test_an_evaluation_names_upper_bounds_and_leaves_out_objects_that_are_all_pixels() -> None:
    views = {"novel": {"psnr": 20.0, "ssim": 0.5, "sharpness": 0.5}, "reference": {"psnr": 20.0, "ssim": 0.5}}
    entry = {"scenes": 2, "views": 4, "full": views, "object": views}
    shown = evaluation_table({"model": entry | {"upper_bound": True}, "mean_image": entry})
    assert [row.cells[0].text for row in shown.rows] == ["model (upper bound)", "mean_image"]
    assert len(shown.headings) == 6
    assert not any("object" in heading.joined() for heading in shown.headings)
