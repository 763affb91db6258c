"""The board: protocols and their lists, what a result states, which results stand in one table, and its page."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf
from PIL import Image
from published_weights import write_published
from srn_trees import write_archive
from support import compose_config, some_gaussians, strict_json

from completesplat.commands.report import board
from completesplat.data.lists import listed_names
from completesplat.errors import BadAnnotation, MissingFile
from completesplat.evaluation.board_results import BoardResult, digest_of, read_results, refusal
from completesplat.evaluation.board_tables import (
    BOARD,
    BoardSection,
    board_markdown,
    board_protocols,
    board_sections,
    board_table,
)
from completesplat.evaluation.protocol import PACKAGE_METRICS
from completesplat.export.ply import write_ply
from completesplat.settings.options import conf_folder

PROTOCOLS = board_protocols()
LISTS = conf_folder() / "evaluation/lists"
SMALL_PICTURE = 50_000  # bytes


def test_there_are_protocols_of_public_objects() -> None:
    names = {"srn_cars", "srn_chairs", "gso", "ycb", "scans", "eth80", "captures", "fruits", "toys", "toys_hidden"}
    assert PROTOCOLS.keys() == names


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_says_what_it_does(name: str) -> None:
    evaluation = compose_config("test", f"evaluation={name}").evaluation
    conditions = evaluation.board.conditions
    if evaluation.board.list is not None:
        text = (LISTS / f"{evaluation.board.list}.txt").read_text()
        names = listed_names(evaluation.board.list)
        assert text == "".join(f"{name}\n" for name in sorted(names))
        assert conditions.list_sha256 == digest_of(names)
        assert conditions.scenes == len(names)
        assert (
            not evaluation.board.pictures or "CC BY" in evaluation.board.about or conditions.data_set.startswith("toy")
        )
    if "resolution" in evaluation:
        assert conditions.resolution == evaluation.resolution
        assert conditions.background == evaluation.data.background
        assert evaluation.data.evaluation_targets is None


def test_a_list_is_a_file_or_one_of_the_package(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("b\n\na\n")
    assert listed_names(str(tmp_path / "mine.txt")) == ["b", "a"]
    assert len(listed_names("scans")) == 37
    with pytest.raises(MissingFile, match=r"nothing: no such file, nor a list of the package \(captures, eth80, "):
        listed_names("nothing")
    (tmp_path / "mine.txt").write_text("a\na\n")
    with pytest.raises(BadAnnotation, match="one name a line, each once"):
        listed_names(str(tmp_path / "mine.txt"))


CONDITIONS = {
    "data_set": "captures",
    "list_sha256": digest_of(["a", "b"]),
    "scenes": 2,
    "resolution": 128,
    "background": 1.0,
    "reference": "a capture's first frame",
    "targets": "its other frames",
}


def result(method: str = "ours", psnr: float = 20.0, copied: float = 10.0, **changed: Any) -> BoardResult:
    scores = {"model": psnr, "copy_reference": copied}
    content = {
        "protocol": "mine",
        "method": method,
        "conditions": CONDITIONS | changed,
        "scores": {name: {"full_novel_psnr": {"mean": x, "standard_error": 0.5}} for name, x in scores.items()},
        "described": {"commit": "f" * 40, "machine": {"date": "2026-11-29"}, "samples": 1, "metrics": {}},
        "upper_bound": False,
    }
    return BoardResult(Path("result.json"), content)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"list_sha256": digest_of(["a", "c"])}, "list_sha256 is "),
        ({"scenes": 3}, "scenes is 3, that of the protocol 2"),
        ({"resolution": 64}, "resolution is 64, that of the protocol 128"),
        ({"background": None}, "background is None, that of the protocol 1.0"),
        ({"reference": "view 64"}, "reference is view 64"),
        ({"targets": "8 others"}, "targets is 8 others"),
        ({"data_set": "co3d"}, "data_set is co3d"),
    ],
)
def test_a_result_under_other_conditions_is_refused(changed: dict[str, object], reason: str) -> None:
    assert refusal(result(), CONDITIONS, copied=10.0) is None
    refused = refusal(result(**changed), CONDITIONS, copied=10.0)
    assert refused is not None
    assert refused.startswith(reason)


def test_a_result_on_other_images_is_refused() -> None:
    assert refusal(result(copied=10.04), CONDITIONS, copied=10.0) is None
    refused = refusal(result(copied=10.2), CONDITIONS, copied=10.0)
    assert refused == "a copy of the input image has 10.20 dB, in other results 10.00: the true images differ"


def test_a_result_with_another_metric_is_refused() -> None:
    other = result()
    psnr = PACKAGE_METRICS["completesplat.metrics.images.psnr"]
    other.content["described"]["metrics"] = {"psnr": psnr}
    assert refusal(other, CONDITIONS, copied=None) is None
    other.content["described"]["metrics"] = {"psnr": psnr | {"limit_db": 60}}
    assert "psnr was measured with " in str(refusal(other, CONDITIONS, copied=None))


def test_results_with_another_number_of_samples_are_refused() -> None:
    """Scores of hidden modes depend on it, while images are scored by the first sample."""
    assert PROTOCOLS["toys_hidden"]["conditions"]["samples"] == 32
    other = result()
    other.content["described"]["samples"] = 4
    assert refusal(other, CONDITIONS, copied=None) is None
    assert refusal(other, CONDITIONS | {"samples": 32}, None) == "samples is 4, that of the protocol 32"
    other.content["described"]["samples"] = 32
    assert refusal(other, CONDITIONS | {"samples": 32}, None) is None


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        (("method",), None, "method is None, not a text"),
        (("described",), [1], "described is [1], not a mapping"),
        (("described", "machine"), None, "machine is None, not a mapping"),
        (("described", "samples"), "four", "samples is four, not a whole number"),
        (("scores",), {}, "it has no scores of the method (model)"),
        (("scores", "model"), 3, "the scores of model are no mapping"),
        (("scores", "model", "full_novel_psnr"), None, "full_novel_psnr of model is None, not a mean and a"),
        (("scores", "model", "full_novel_psnr", "mean"), "20", "full_novel_psnr of model is "),
        (("scores", "copy_reference", "full_novel_psnr", "mean"), float("nan"), "full_novel_psnr of copy_reference"),
        (("scores", "model", "full_novel_psnr", "standard_error"), float("inf"), "full_novel_psnr of model is "),
    ],
)
def test_a_result_that_was_edited_by_hand_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, path: tuple[str, ...], value: object, fault: str
) -> None:
    content = json.loads(json.dumps(dict(result().content) | {"protocol": "toys"}))
    place = content
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    (tmp_path / "edited.json").write_text(json.dumps(content))
    board(str(tmp_path), tmp_path)
    assert f"edited.json: left out, because {fault}" in caplog.text


def test_a_result_without_an_entry_is_named_and_other_files_are_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name, text in (("a", "{"), ("b", '{"protocol": "toys"}')):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(text)
    (tmp_path / "metrics.json").write_text("[1]")
    board(str(tmp_path), tmp_path)
    assert "a/result.json: left out, because it cannot be read as a mapping in JSON" in caplog.text
    assert "b/result.json: left out, because it has no method" in caplog.text
    assert "metrics" not in caplog.text


def test_nothing_is_left_out_in_silence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "empty").mkdir()
    board(str(tmp_path / "empty"), tmp_path)
    assert "empty: no result.json of completesplat test evaluation=PROTOCOL" in caplog.text
    (tmp_path / "theirs.json").write_text(json.dumps(dict(result().content)))
    board(str(tmp_path), tmp_path)
    assert "theirs.json: left out, because there is no protocol mine in conf/evaluation here" in caplog.text


BOARD_OF_MINE = {
    "title": "Mine",
    "about": "Two things, CC BY.",
    "list": None,
    "pictures": False,
    "conditions": CONDITIONS,
    "published": [{"method": "Theirs", "source": "Somebody, 2024", "scores": {"full_novel_psnr": 24.0}}],
}


def test_methods_stand_before_naive_predictors_and_published_figures_stand_apart() -> None:
    better = result("better", 21.0)
    seen = result("fitted", 30.0)
    seen.content["upper_bound"] = True  # type: ignore[index]
    table = board_table(BoardSection("mine", BOARD_OF_MINE, [result(), seen, better], []))
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    assert [row[0] for row in rows] == [
        "fitted (has seen the scored views)",
        "better",
        "ours",
        "copy of the input",
        "Theirs, as published",
    ]
    assert rows[1] == ["better", "21.00 ± 0.50", "2026-11-29, ffffffff"]
    assert rows[-1] == ["Theirs, as published", "24.00", "Somebody, 2024"]
    assert [row.cells[1].mark for row in table.rows] == ["", "best", "second", "", ""]


def test_a_scale_that_was_fitted_to_true_depth_is_stated() -> None:
    scaled = result()
    scaled.content["described"]["align"] = "scale"
    table = board_table(BoardSection("mine", BOARD_OF_MINE, [scaled], []))
    assert table.rows[0].cells[0].text == "ours (scale fitted to true depth)"


def test_a_method_name_stays_in_its_row() -> None:
    table = board_table(BoardSection("mine", BOARD_OF_MINE, [result("two\nlines")], []))
    assert table.rows[0].cells[0].text == r"two\nlines"


def test_links_to_pictures_have_no_spaces(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "my result (1).jpg")
    shown = replace(result(), file=tmp_path / "my result (1).json")
    page = board_markdown([BoardSection("mine", BOARD_OF_MINE, [shown], [])], tmp_path)
    assert "](my%20result%20%281%29.jpg)" in page


def test_the_page_shows_pictures_beside_results(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "mine/ours.jpg")
    shown = replace(result("ours"), file=tmp_path / "mine/ours.json")
    page = board_markdown([BoardSection("mine", BOARD_OF_MINE, [shown], [])], tmp_path)
    assert "](mine/ours.jpg)" in page
    assert "| ours | **20.00 ± 0.50** |" in page
    empty = board_markdown([BoardSection("mine", BOARD_OF_MINE | {"published": []}, [], [])], tmp_path)
    assert "No results yet." in empty


def test_results_in_the_package_belong_to_their_protocols_and_are_its_page() -> None:
    sections = board_sections(())
    assert [reason for section in sections for reason in section.refused] == []
    assert sum(len(section.results) for section in sections) == len(read_results(BOARD).results) > 4
    assert read_results(BOARD).left_out == []
    for section in sections:
        for stored in section.results:
            assert stored.file.parent.name == section.name
            assert stored.picture is None or section.board["pictures"]
            assert stored.picture is None or stored.picture.stat().st_size < SMALL_PICTURE
            assert "/root" not in stored.file.read_text()
    assert board_markdown(sections, BOARD) == (BOARD / "README.md").read_text()


@pytest.fixture
def own_protocol(tmp_path: Path, toy_root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder with a protocol of the user's own, and scenes of another program for its one scene."""
    monkeypatch.chdir(tmp_path)
    data = compose_config("test", "data=toy_objects", f"data.root={toy_root}").data
    from hydra.utils import instantiate

    (name,) = instantiate(OmegaConf.create({"seed": 0, "data": data}).data, image_size=32).source("test").names
    (tmp_path / "mine.txt").write_text(f"{name}\n")
    conditions = {
        "data_set": "toy_objects",
        "list_sha256": digest_of([name]),
        "scenes": 1,
        "resolution": 32,
        "background": 1.0,
        "reference": "a sequence's first frame",
        "targets": "its other frames",
    }
    own = BOARD_OF_MINE | {"list": "mine.txt", "pictures": True, "conditions": conditions, "published": []}
    config = {
        "defaults": ["images", "_self_"],
        "name": "mine",
        "data_set": "toy_objects",
        "data": {"evaluation_targets": None, "background": 1.0},
        "resolution": 32,
        "board": own,
    }
    (tmp_path / "conf/evaluation").mkdir(parents=True)
    OmegaConf.save(OmegaConf.create(config), tmp_path / "conf/evaluation/mine.yaml")
    (tmp_path / "SPLATS" / name).mkdir(parents=True)
    gaussians = some_gaussians(1)[0]
    moved = replace(gaussians, means=gaussians.means + gaussians.means.new_tensor([0.0, 0.0, 2.0]))
    write_ply(tmp_path / "SPLATS" / name / "sample_0.ply", moved)
    return tmp_path


def test_files_of_another_program_get_a_row(command, own_protocol: Path, toy_root: Path) -> None:
    data = ["data=toy_objects", f"data.root={toy_root}"]
    given = ["scenes=SPLATS", *data, "method=theirs", "evaluation=mine", "trainer.accelerator=cpu", "out=OUT"]
    finished = command.succeeds("test", *given)
    assert "for the board: OUT/result.json" in finished.out.replace(f"{own_protocol}/", "")
    written = strict_json(own_protocol / "OUT/result.json")
    assert (written["protocol"], written["method"]) == ("mine", "theirs")
    scores = strict_json(own_protocol / "OUT/metrics.json")
    assert written["scores"]["model"]["full_novel_psnr"]["mean"] == pytest.approx(
        scores["model"]["full"]["novel"]["psnr"]
    )
    assert {"copy_reference", "mean_image", "flat_reference"} <= written["scores"].keys()
    assert list(written["described"]["files"]) == [f"{(own_protocol / 'mine.txt').read_text().strip()}/sample_0.ply"]
    assert {"version", "command", "machine", "data_fingerprint", "metrics"} <= written["described"].keys()
    assert Image.open(own_protocol / "OUT/result.jpg").size == (7 * 96, 96)
    printed = command.succeeds("report", "board", "results=OUT", "out=TABLE").out
    assert "theirs" in printed
    page = (own_protocol / "TABLE/board.md").read_text()
    assert "| theirs |" in page
    assert "](../OUT/result.jpg)" in page


def test_files_are_rendered_at_the_size_of_the_protocol(command, own_protocol: Path, toy_root: Path) -> None:
    data = ["data=toy_objects", f"data.root={toy_root}", "data.image_size=16"]
    command.succeeds("test", "scenes=SPLATS", *data, "evaluation=mine", "trainer.accelerator=cpu", "out=MY OUT")
    assert strict_json(own_protocol / "MY OUT/metrics.json")["protocol"]["image_size"] == 32


def test_a_protocol_without_an_entry_is_refused(command, own_protocol: Path, toy_root: Path) -> None:
    path = own_protocol / "conf/evaluation/mine.yaml"
    config = OmegaConf.load(path)
    del config.board["published"]
    OmegaConf.save(config, path)
    message = "evaluation=mine: board has no published; see scans.yaml"
    assert message in command.refuses("report", "board", "out=TABLE")
    data = ["data=toy_objects", f"data.root={toy_root}"]
    assert message in command.refuses("test", "scenes=SPLATS", *data, "evaluation=mine", "out=OUT")
    path.write_text("name: [")
    assert "evaluation=mine: while parsing a flow node" in command.refuses("report", "board", "out=TABLE")


def test_a_protocol_of_other_data_says_so(command, own_protocol: Path, toy_root: Path) -> None:
    given = ["scenes=SPLATS", "data=toy_objects", f"data.root={toy_root}", "evaluation=srn_cars", "out=OUT"]
    expected = "evaluation=srn_cars is of srn: the data of this run have no setting reference"
    assert expected in command.refuses("test", *given)


def test_a_scene_of_the_list_that_is_missing_is_named(command, own_protocol: Path, toy_root: Path) -> None:
    (own_protocol / "mine.txt").write_text("nowhere\n")
    data = ["data=toy_objects", f"data.root={toy_root}", "data.image_size=32"]
    refused = command.refuses("test", "scenes=SPLATS", *data, "evaluation=mine", "out=OUT")
    assert "lacks 1 of the 1 scene of the protocol's list: nowhere" in refused


def test_other_results_are_left_out_with_the_reason(own_protocol: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = json.loads(json.dumps(dict(result().content))) | {"protocol": "toys"}
    (own_protocol / "theirs.json").write_text(json.dumps(content))
    (own_protocol / "OUT").mkdir()
    board(str(own_protocol), own_protocol / "OUT")
    assert "theirs.json: left out, because data_set is captures, that of the protocol toy_objects" in caplog.text


def test_splatter_images_published_architecture_passes_the_protocol_of_srn(command, tmp_path: Path) -> None:
    """Random weights, and an archive of two cars with 66 views: the input is view 64, all others are scored."""
    weights = write_published(tmp_path / "weights", "cars")
    write_archive(tmp_path / "srn_cars", "cars", {"train": ["a"], "val": ["b"], "test": ["c", "d"]}, 66, size=128)
    given = [f"weights={weights}", "data=srn_cars", f"data.root={tmp_path / 'srn_cars'}", "evaluation=srn_cars"]
    command.succeeds("test", *given, "data.workers=0", "trainer.accelerator=cpu", f"out={tmp_path / 'out'}")
    described = strict_json(tmp_path / "out/metrics.json")["protocol"]
    assert described["protocol_views"] == "reference: view 64; targets: its other frames"
    assert (described["image_size"], described["resolution"], described["background"]) == (16, 128, 1)
    assert (described["scenes"], described["views"]) == (2, 2 * 65)
    written = BoardResult(tmp_path, strict_json(tmp_path / "out/result.json"))
    reason = refusal(written, PROTOCOLS["srn_cars"]["conditions"], None)
    assert reason == "scenes is 2, that of the protocol 704"
    whole = {name: 704 if name == "scenes" else value for name, value in written.content["conditions"].items()}
    counted = replace(written, content={**written.content, "conditions": whole})
    assert refusal(counted, PROTOCOLS["srn_cars"]["conditions"], None) is None
