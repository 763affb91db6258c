"""Places of runs in the paper's tables or in a table of ours, and the texts of their cells."""

import json
import os
from pathlib import Path

import pytest
from readers import put
from support import only_with_byte_names

from completesplat.errors import CompleteSplatError
from completesplat.evaluation import paper_tables
from completesplat.evaluation.paper_tables import published_tables
from completesplat.evaluation.records import find_results
from completesplat.evaluation.tables import ABSENT, BEST, SECOND, SSIM_NOTE, Cell, Table
from completesplat.settings.options import options

HYDRANTS = {"name": "co3d", "data_set": "co3d/hydrant", "resolution": 128, "image_size": 128, "scenes": 77}
HYDRANTS |= {"subset": "fewview_dev", "scenes_listed": 77}
HYDRANTS |= {"protocol_views": "reference: a sequence's first frame; targets: its other frames"}
INDEX = {"protocol_views": "index in pixelSplat's format, SHA-256 fbcff9b4b131"}
ROOMS = INDEX | {"data_set": "realestate10k", "image_size": 128}
ALL_ROOMS = ROOMS | {"name": "realestate10k_128", "resolution": 128, "scenes": 6473}
FAR = {"protocol_views": "reference: first frame; 1 targets, the last 150 frames away"}
SOME_ROOMS = ROOMS | FAR | {"name": "realestate10k_100", "resolution": 128, "scenes": 100}
PAPERS = ["full_images", "realestate10k", "ablations", "objects_only"]


def made(runs) -> dict[str, Table]:
    return {table.name: table for table in published_tables(find_results(runs))}


def texts(table: Table) -> list[dict[str, str]]:
    """Return the rows by heading."""
    names = [heading.joined(" ") for heading in table.headings]
    return [{name: cell.text for name, cell in zip(names, row.cells, strict=True)} for row in table.rows]


def ours(table: Table) -> list[dict[str, str]]:
    """Return the rows that are not the paper's, by heading."""
    return [row for row, shown in zip(texts(table), table.rows, strict=True) if shown.source != "paper"]


def test_a_run_by_the_papers_protocol_stands_below_its_rows_in_its_own_columns(runs, run) -> None:
    alone = published_tables(None)
    assert [table.name for table in alone] == PAPERS
    assert not any(ours(table) for table in alone)
    run("a", 17.456, **HYDRANTS)
    by_name = made(runs)
    assert list(by_name) == PAPERS
    (row,) = ours(by_name["full_images"])
    assert row["method"] == "completesplat: VariationalAutoReconstructor [1]"
    assert (row["Hydrants PSNR ↑"], row["Teddybears PSNR ↑"]) == ("17.46", "-")
    assert (row["time per sequence inference"], row["time per sequence rendering"]) == ("15.7 ms", "4.1 min")
    assert (row["scenes"], row["pixels"]) == ("77", "128")
    assert ours(by_name["objects_only"])[0]["Hydrants PSNR ↑"] == "18.46"


@pytest.mark.parametrize(
    "different",
    [
        {"name": "images"},
        {"resolution": 64},
        {"skipped": 3},
        {"subset": "fewview_train"},
        {"scenes": 76},
        {"data_set": "toy_objects"},
        {"skip_weight": 0.0},  # the tables are scored with skip connections
        {"background": 0.0},
        {"protocol_views": "reference: a sequence's first frame; targets: 5 others"},
        SOME_ROOMS | {"scenes": 99},
        ALL_ROOMS | {"scenes": 100},
        ALL_ROOMS | FAR,
    ],
)
def test_a_run_by_another_protocol_stands_in_a_table_of_its_own(runs, run, different) -> None:
    run("a", 17.5, **(HYDRANTS | different))
    by_name = made(runs)
    assert not any(ours(by_name[name]) for name in PAPERS)
    (row,) = ours(by_name["own_1"])
    assert row["all pixels, novel views PSNR ↑"] == "17.50"


def test_runs_with_the_papers_scenes_and_resolutions_are_listed(runs, run) -> None:
    sizes = [(100, 128), (6473, 128), (6473, 256), (6474, 128)]
    large = ALL_ROOMS | {"name": "realestate10k_256", "resolution": 256}
    for index, protocol in enumerate([SOME_ROOMS, ALL_ROOMS, large, ALL_ROOMS | {"scenes": 6474}]):
        run(f"run{index}", 20.0, **protocol)
    run("too many", 20.0, **ALL_ROOMS | {"scenes": 6475})
    table = made(runs)["realestate10k"]
    assert [(int(row["scenes"]), int(row["pixels"])) for row in ours(table)] == sizes
    below = " ".join(table.below())
    assert "6,474" in below
    assert "39" in below  # of the 100 scenes, which nobody can have


@pytest.mark.parametrize(("samples", "table"), [(20, "full_images"), (8, "own_1")])
def test_an_oracle_stands_beside_one_of_as_many_samples_only(runs, run, samples, table) -> None:
    several = {"samples": samples, "sampler": "DDIMScheduler", "method": "LatentDiffusion"}
    run("a", 17.0, {"best_of_k": 18.0, "best_of_k_by_metric": 18.5}, **HYDRANTS, **several, criterion="psnr")
    by_name = made(runs)
    labels = [row["method"] for row in ours(by_name[table])]
    for chosen in ("PSNR", "each metric"):
        assert f"completesplat: LatentDiffusion, {samples}-best oracle by {chosen} [1]" in labels
    assert ours(by_name["full_images"])[0]["method"] == "completesplat: LatentDiffusion, single sample [1]"
    assert ("own_1" in by_name) == (samples != 20)


def test_models_that_have_seen_their_views_are_not_beside_the_paper(runs, run) -> None:
    path = run("a", 30.0, **HYDRANTS)
    tested = json.loads(path.read_text())
    run("b", 20.0, **HYDRANTS)
    seen = tested | {"model": tested["model"] | {"upper_bound": True}}
    for results in (seen, {"test": seen}):  # as `test` and `fit` write it
        path.write_text(json.dumps(results))
        by_name = made(runs)
        assert [row["Hydrants PSNR ↑"] for row in ours(by_name["full_images"])] == ["20.00"]
        assert "(upper bound)" in ours(by_name["own_1"])[0]["method"]


def test_own_tables_hold_only_what_was_measured_alike(runs, run) -> None:
    changes = [{}, {"name": "other"}, {"scenes": 19}, {"views": 79}, {"data_fingerprint": "x"}, {"crop": "y"}]
    for index, change in enumerate([{}, *changes]):
        run(f"run{index}", 20.0 + index, **change)
    rows = [len(ours(table)) for name, table in made(runs).items() if name.startswith("own_")]
    assert sorted(rows) == [1] * 5 + [2]


def test_best_and_second_of_our_own_are_marked_and_naive_predictors_are_not(runs, run) -> None:
    for name, psnr in {"a": 20.0, "b": 22.0, "c": 21.0}.items():
        run(name, psnr, {"mean_image": 99.0})
    table = made(runs)["own_1"]
    column = [heading.text for heading in table.headings].index("PSNR ↑")
    cells = [(row.cells[column].text, row.cells[column].mark) for row in table.rows]
    assert cells == [("20.00", ""), ("22.00", "best"), ("21.00", "second"), ("99.00", "")]  # and once only
    assert any(SSIM_NOTE in line for line in table.below())


def test_missing_scores_have_a_reason_below_the_table(runs, run) -> None:
    run("a", 17.5, **HYDRANTS, missing={"lpips": "missing: no weights of VGG"})
    table = made(runs)["full_images"]
    (row,) = ours(table)
    reasons = {"LPIPS ↓": "lpips: missing: no weights of VGG", "KID ↓": "kid: not measured for model"}
    for column, reason in reasons.items():
        text = row[f"Hydrants {column}"]
        assert text.startswith("missing: note ")
        assert f"[{text.removeprefix('missing: note ')}] {reason}" in table.below()


STYLED = '{"protocol": {"data_set": "x", "scenes": 1, "resolution": 2, "metrics": {"a": {"style": {"colour": 1}}}}, '
STYLED += '"model": {}}'


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "cannot be read as a mapping in JSON"),
        ('{"steps": 9}', "does not say how it was measured"),
        ('{"protocol": {"data_set": "x", "scenes": 1}, "model": {}}', "does not say how it was measured"),
        ('{"protocol": {"data_set": "x", "scenes": 1, "resolution": 2}}', "no scores"),
        (STYLED, "a metric's style in it is not one of this version"),
    ],
)
def test_a_broken_or_foreign_file_is_left_out_with_a_line(runs, run, content, reason) -> None:
    run("good", 20.0)
    (runs / "bad").mkdir()
    (runs / "bad/metrics.json").write_text(content)
    tree = find_results(runs)
    (warning,) = tree.warnings
    assert warning.startswith(f"{runs / 'bad/metrics.json'}: left out, ")
    assert reason in warning
    assert "\n" not in warning
    assert len(published_tables(tree)) == len(PAPERS) + 1


def test_folders_that_links_lead_to_are_searched_once(runs, run, tmp_path) -> None:
    run("good", 20.0)
    (tmp_path / "links").mkdir()
    (tmp_path / "links/there").symlink_to(runs)
    (runs / "good/back").symlink_to(runs)
    assert [score.name for score in find_results(tmp_path / "links").scores] == ["there/good"]
    (runs / "latest").symlink_to(runs / "good")  # beside its target
    assert len(find_results(runs).scores) == 1


def test_a_folder_without_results_is_refused_with_what_makes_them(runs) -> None:
    with pytest.raises(CompleteSplatError, match="completesplat test"):
        published_tables(find_results(runs))
    with pytest.raises(CompleteSplatError, match="no such folder"):
        find_results(runs / "nowhere")


def test_hidden_modes_have_a_table_of_their_own_unless_a_protocol_is_missing(runs) -> None:
    scores = {"coverage": 0.5, "total_variation": 0.25, "mode_distance": 1.0, "rejected": 0.125}
    scores |= {"scenes": 4, "samples": 32}
    protocol = {"scenes": ["x", "y"], "method": "LatentDiffusion", "samples": 32, "data_fingerprint": "f00d"}
    for name in ("a", "b", "lacking"):
        (runs / name).mkdir()
        modes = {"true_sampler": scores, "model": scores | {"coverage": 0.75}}
        (runs / name / "hidden_modes.json").write_text(json.dumps(modes))
        (runs / name / "protocol.json").write_text(json.dumps(protocol))
    (runs / "lacking/protocol.json").unlink()
    assert "does not say how it was measured" in find_results(runs).warnings[0]
    table = made(runs)["hidden_modes_1"]
    rows = ours(table)
    assert table.title == "Hidden modes, data f00d"
    assert "[1] a: scenes 2, samples 32, data f00d." in table.below()
    assert [row["method"] for row in rows] == ["LatentDiffusion [1]", "LatentDiffusion [2]", "true sampler [1]"]
    assert [row["coverage ↑"] for row in rows] == ["0.750", "0.750", "0.500"]
    assert (rows[0]["samples"], rows[0]["total variation ↓"]) == ("32", "0.250")


SWEPT = {"data_set": "toy_objects", "resolution": 32, "scenes": 9, "missing": {"lpips": "missing: no weights"}}


@pytest.fixture
def job(runs: Path, sweep):
    """Writes a finished job of the sweep `runs/sweep`."""
    sweep.folder = runs / "sweep"

    def write(ablation: str, seed: int, psnr: float, **protocol) -> None:
        seconds = {"inference": 2.0 + seed, "rendering": 0.5}
        model = {"scenes": 9, "views": 9, "seconds": seconds, "full": {"novel": {"psnr": psnr, "ssim": 0.5}}}
        mean_image = {"scenes": 9, "views": 9, "full": {"novel": {"psnr": 10.0}}}
        test = {"protocol": SWEPT | protocol, "model": model, "mean_image": mean_image}
        sweep.add(f"ablation={ablation}", f"seed={seed}", test=test)

    return write


def test_a_sweep_stands_below_the_papers_rows_by_protocol(runs, job) -> None:
    for seed in (0, 1):
        job("full", seed, 20.0 + seed)
        job("no_skips", seed, 15.0)
    job("m1", 0, 9.0, resolution=64)
    by_name = made(runs)
    assert list(by_name) == PAPERS  # and no table of jobs
    table = by_name["ablations"]
    rows = {next(iter(row.values())).removeprefix("completesplat: "): row for row in ours(table)}
    full = next(row for label, row in rows.items() if label.startswith("full (Our AutoReconstructor), 2 seeds"))
    assert full["PSNR ↑"] == "20.50 ± 0.71"
    assert len({label[-3:] for label in rows}) == 2  # notes on two protocols
    assert f"[{full['LPIPS ↓'].removeprefix('missing: note ')}] lpips: missing: no weights" in table.below()
    assert any("resolution 64" in line for line in table.below())


def test_a_test_in_a_sweeps_folder_has_a_table_of_its_own(runs, job, run) -> None:
    job("full", 0, 20.0)
    job("no_skips", 0, 15.0)
    run("sweep/test-of-full", 33.33)
    (row,) = ours(made(runs)["own_1"])
    assert "33.33" in row.values()


@only_with_byte_names
def test_names_that_are_no_text_are_escaped(runs, run) -> None:
    run("bad", 20.0).parent.rename(os.fsdecode(os.fsencode(runs) + b"/bad\xff\n"))
    assert any(line.startswith("[1] bad\\udcff\\n: ") for line in made(runs)["own_1"].below())


def test_a_sweep_of_an_earlier_version_whose_records_do_not_name_it_counts_as_single_runs(runs, job) -> None:
    job("full", 0, 20.0)
    job("no_skips", 0, 15.0)
    for record in runs.glob("sweep/*/run.json"):
        put("run.json", "sweep", ...)(record.parent)
    by_name = made(runs)
    assert list(by_name) == [*PAPERS, "own_1"]
    assert len(ours(by_name["own_1"])) == 3  # both models, and the mean image once
    assert ours(by_name["ablations"]) == []


def test_ablations_without_a_row_in_the_paper_stand_below_its_rows(runs, job) -> None:
    job("no_kl", 0, 20.0)
    job("fewer_layers", 0, 21.0)
    by_name = made(runs)
    assert list(by_name) == PAPERS
    rows = [next(iter(row.values())).partition(",")[0] for row in ours(by_name["ablations"])]
    assert {"completesplat: fewer_layers", "completesplat: no_kl"} <= set(rows)


def test_a_sweep_without_ablations_counts_as_single_runs(runs, sweep, job) -> None:
    for channels in (32, 64):
        test = {"protocol": SWEPT, "model": {"scenes": 9, "views": 9, "full": {"novel": {"psnr": 20.0}}}}
        sweep.add(f"denoiser.channels=[{channels}]", test=test)
    assert [table.name for table in published_tables(find_results(runs))] == [*PAPERS, "own_1"]


def test_every_published_table_is_complete() -> None:
    for table in paper_tables.read_tables():
        rows = paper_tables.printed_rows(table)
        assert all(len(row) == len(table.columns) for row in rows)
        assert all(data_set for *_, data_set in paper_tables.score_columns(table))
        text = " ".join(cell.text for row in rows for cell in row)
        assert {name for name, sign in paper_tables.SIGNS.items() if sign in text} == set(table.get("legend", {}))


def ranked(cells: list[Cell], higher_is_better: bool) -> list[Cell]:
    return sorted(cells, key=lambda cell: float(cell.text), reverse=higher_is_better)


@pytest.mark.parametrize(("name", "unmarked"), [("ablations", []), ("objects_only", [8])])
def test_typed_figures_are_in_the_order_of_the_marks_that_the_paper_prints(name, unmarked) -> None:
    """In these two tables all rows compete; the paper marks none in one column."""
    (table,) = (table for table in paper_tables.read_tables() if table.name == name)
    for number, column, _ in paper_tables.score_columns(table):
        cells = [row[number] for row in paper_tables.printed_rows(table) if row[number].text != ABSENT]
        best, second, *others = ranked(cells, column.key == "psnr")
        if number in unmarked:
            assert not any(cell.mark for cell in cells)
            continue
        assert (best.mark, second.mark) == (BEST, SECOND)
        assert all(float(cell.text) == float(second.text) for cell in others if cell.mark)


def test_every_protocol_of_a_table_is_there_and_every_option_of_a_row() -> None:
    assert {name for table in paper_tables.read_tables() for name in table.evaluations} <= set(options("evaluation"))
    (table,) = (table for table in paper_tables.read_tables() if table.get("options"))
    assert set(table.options.values()) == {row[0].text for row in paper_tables.printed_rows(table)}
    assert set(table.options) <= {*options("ablation"), *options("model")}
