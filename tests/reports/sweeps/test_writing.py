"""The files of a sweep's summary, and what the terminal shows."""

import json
import re

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest

from completesplat.results.rows import IDENTITY
from completesplat.results.sweeps import escape, show_summary, summarize, write_summary
from completesplat.results.tables import SSIM_NOTE

FILES = ["summary.csv", "summary.md", "summary.png", "summary.tex"]


def blue(folder) -> np.ndarray:
    """Which pixels of the chart have the colour of bars, matplotlib's C0."""
    return (imageio.imread(folder / "summary.png")[..., :3] == (31, 119, 180)).all(-1)


def longest_run(line: np.ndarray) -> int:
    return max(map(len, re.findall("1+", "".join(map(str, line.astype(int))))), default=0)


def test_nothing_but_the_four_files_is_written(ablations) -> None:
    before = {path.name for path in ablations.folder.iterdir()}
    write_summary(ablations.folder)
    write_summary(ablations.folder)
    assert sorted({path.name for path in ablations.folder.iterdir()} - before) == FILES


def test_markdown_shows_means_deviations_and_marks(ablations, written) -> None:
    lines = written(ablations).splitlines()
    head, rule, m1, no_skips, full, mean_image, copy_reference = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines[:7]
    )
    assert head[:5] == [
        "ablation", "seeds", "scenes", "all pixels, novel views: PSNR ↑", "all pixels, novel views: SSIM ↑"
    ]  # fmt: skip
    assert len(rule) == len(head) == 8
    # Offsets 0, 0.25 and 1.25 have the mean 0.5 and the deviation sqrt(0.4375) = 0.66.
    assert m1[:4] == ["m1", "3", "40", "<ins>20.50 ± 0.66</ins>"]
    assert no_skips[3:5] == ["19.00 ± 0.66", "0.685 ± 0.000"]
    assert full[3:6] == ["**22.50 ± 0.66**", "**0.720 ± 0.000**", "**20.50 ± 0.66**"]
    assert mean_image == ["mean_image", "", "40", "15.00", "", "", "", ""]
    assert copy_reference[3] == "12.00"


def test_latex_has_booktabs_rules_and_as_many_cells_as_columns(ablations) -> None:
    write_summary(ablations.folder)
    text = (ablations.folder / "summary.tex").read_text()
    assert [text.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [1, 2, 1]
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert [row.count(" & ") for row in rows[1:]] == [7] * 6
    spanned = sum(int(count) for count in re.findall(r"\\multicolumn\{(\d+)\}", rows[0]))
    assert 3 + spanned == 8
    assert r"{lrrrrrrr}" in text
    assert r"no\_skips & 3 & 40 & 19.00 $\pm$ 0.66 & " in text
    assert r"\textbf{22.50 $\pm$ 0.66}" in text
    assert r"\underline{20.50 $\pm$ 0.66}" in text
    assert text.count("{") == text.count("}")
    assert re.search(r"(?<!\\)_", text) is None
    assert text.isascii()


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("no_skips", r"no\_skips"),
        ("50% & #1", r"50\% \& \#1"),
        ("a={b: $c}", r"a=\{b: \$c\}"),
        ("x^2~y", r"x\textasciicircum{}2\textasciitilde{}y"),
        (r"a\b", r"a\textbackslash{}b"),
        ("1 ± 2", r"1 $\pm$ 2"),
    ],
)
def test_latex_prints_special_characters_literally(text, printed) -> None:
    assert escape(text) == printed


def test_all_remarks_and_the_command_stand_below_both_tables(ablations, written) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    markdown = written(ablations)
    tex = (ablations.folder / "summary.tex").read_text()
    summary = summarize(ablations.folder)
    assert len(summary.remarks) == 4
    for said in (SSIM_NOTE, *summary.remarks, *summary.commands):
        assert said in markdown
        assert escape(said) in tex


def test_a_bar_in_a_cell_of_markdown_does_not_end_the_cell(sweep, written) -> None:
    for value in ("a|b", "c"):
        sweep.scored(f"some.key={value}", psnr=20.0)
    assert r"| some.key=a\|b | 1 |" in written(sweep)


def test_a_sweep_without_finished_jobs_says_so(sweep, written, capsys) -> None:
    sweep.add("ablation=m1")
    markdown = written(sweep)
    assert markdown.startswith("No job of this sweep has finished.")
    assert "0 of 1 jobs have finished." in markdown
    assert "No job of this sweep has finished." in (sweep.folder / "summary.tex").read_text()
    assert list(pd.read_csv(sweep.folder / "summary.csv").columns) == IDENTITY
    assert len(np.unique(imageio.imread(sweep.folder / "summary.png"))) > 1
    assert not blue(sweep.folder).any()
    show_summary(summarize(sweep.folder))
    assert "Not finished: job=0." in capsys.readouterr().out


def test_a_folder_without_jobs_says_so(sweep, written) -> None:
    sweep.folder.mkdir()
    assert "0 of 0 jobs have finished." in written(sweep)


def test_the_chart_draws_bars_as_long_as_the_means(sweep) -> None:
    for ablation, psnr in {"full": 24.0, "m1": 12.0, "no_skips": 18.0}.items():
        sweep.scored(f"ablation={ablation}", psnr=psnr)
    for run in sweep.folder.glob("*/metrics.json"):  # no lines across the bars
        metrics = json.loads(run.read_text())
        run.write_text(json.dumps(metrics | {"test": {"model": metrics["test"]["model"]}}))
    write_summary(sweep.folder)
    bars = [longest_run(line) for line in blue(sweep.folder)]
    lengths = [length for length, before in zip(bars[1:], bars, strict=False) if length > 50 and before == 0]
    np.testing.assert_allclose(np.array(lengths) / lengths[-1], [12 / 24, 18 / 24, 1], atol=0.02)


def test_the_chart_draws_the_mean_image_where_its_score_is(sweep) -> None:
    sweep.scored("ablation=full", psnr=30.0)
    write_summary(sweep.folder)
    image = imageio.imread(sweep.folder / "summary.png")[..., :3]
    bar = blue(sweep.folder)
    columns = np.flatnonzero(bar.sum(0) > 20)
    rows = np.flatnonzero(bar.sum(1) > 100)
    black = (image[rows[0] : rows[-1]].astype(int).sum(-1) < 100).mean(0)
    found = [x for x in range(columns[0] + 5, columns[-1] - 5) if black[x] > 0.2]
    middle = (columns[0] + columns[-1]) / 2  # the mean image scores half of 30
    assert min(abs(x - middle) for x in found) <= 3


def test_the_terminal_shows_the_headline_and_what_is_missing(ablations, capsys) -> None:
    ablations.add("ablation=m1", "seed=7")
    ablations.scored("ablation=x[red]", psnr=1.0)
    show_summary(summarize(ablations.folder))
    said = capsys.readouterr().out
    assert "22.50 ± 0.66" in said
    assert "x[red]" in said
    assert "…" not in said
    assert "10 of 11 jobs have finished." in said
    assert "Not finished: job=9." in said
