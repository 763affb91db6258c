"""`completesplat report html`: one page, of which nothing outside is asked, with all that was found."""

import io
import re
from base64 import b64decode
from pathlib import Path

import pytest
from PIL import Image
from report_pages import FRAMES, HOSTILE, SAMPLES, Page, grey, write_results
from support import compose_config, refused

from completesplat.commands.jobs import start
from completesplat.results.html_page import frame_strip


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    write_results(root)
    return root


def written(runs: Path, out: Path, *settings: str) -> str:
    out.mkdir(exist_ok=True)
    start("report", compose_config("report", "report_task=html", f"runs={runs}", *settings), out)
    return (out / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def raw(results, tmp_path_factory):
    return written(results, tmp_path_factory.mktemp("page"), "most.frames=6")


@pytest.fixture(scope="module")
def page(raw):
    return Page(raw)


def decoded(uri: str) -> Image.Image:
    return Image.open(io.BytesIO(b64decode(uri.partition("base64,")[2])))


def test_the_page_asks_for_nothing_nor_do_its_own_styles_and_scripts(page, raw):
    assert page.open == []
    for name, attributes in page.elements:
        assert name not in ("link", "iframe", "object", "embed", "base", "form", "video")
        for attribute in ("src", "href", "srcset", "data", "poster", "action"):
            assert (attributes.get(attribute) or "#").startswith(("data:image/", "#")), (name, attributes)
        assert not any(attribute.startswith("on") for attribute in attributes)
    (policy,) = page.all("meta", http_equiv="Content-Security-Policy")
    assert (policy["content"] or "").startswith("default-src 'none';")
    assert len(page.all("script")) == len(page.all("style")) == 1
    for own in re.findall(r"<(?:style|script)>(.*?)</", raw, re.DOTALL):
        assert not re.search(r"https?:|url\(|@import|fetch|import\(", own)


def test_every_run_is_there_and_hostile_names_are_text(page):
    assert len(page.all("details", class_="run")) == 3
    for message in ("21.12", "0.875", "17.25", "completesplat fit 'a=b c'", "c0ffee", "2026-11-21", "Table 2"):
        assert message in page.text, message
    assert page.text.count(HOSTILE) >= 4  # the run, its settings, its method in a table, and its figures
    assert any(HOSTILE in (image["alt"] or "") for image in page.all("img"))


def test_every_image_has_a_description_and_wide_ones_are_reduced(page):
    assert all(image["alt"] for image in page.all("img"))
    assert all(box["aria-label"] for box in page.all("div", class_="scroll"))
    (figure,) = [image for image in page.all("img") if "hidden_modes" in (image["alt"] or "")]
    assert decoded(figure["src"]).size == (1600, 40)


def test_every_sample_turns_as_its_video_does_and_a_short_video_gives_all_its_frames(page, results):
    boxes = page.all("div", class_="turntable")
    images = [image for image in page.all("img") if "seen from" in (image["alt"] or "")]
    assert len(boxes) == len(images) == SAMPLES
    for sample, (box, image) in enumerate(zip(boxes, images, strict=True)):
        assert (box["data-frames"], box["role"], box["tabindex"]) == ("6", "slider", "0")
        drawn = decoded(image["src"]).convert("L")
        side = drawn.width // 6
        assert drawn.height == side
        for frame in range(6):
            middle = drawn.getpixel((frame * side + side // 2, side // 2))
            assert middle == pytest.approx(255 * grey(sample, frame * FRAMES // 6), abs=6)
    whole, frames = frame_strip(results / "predictions/x/orbit_00.mp4", 48)
    assert (frames, whole.width) == (FRAMES, FRAMES * whole.height)


def test_images_beyond_the_limits_are_left_out_and_counted(results, tmp_path):
    page = Page(written(results, tmp_path, "most.images=2", "most.samples=1", "most.runs=2"))
    assert "3 more in" in page.text
    assert "2 more samples left out" in page.text
    assert "1 more runs left out" in page.text
    steps = [image["alt"] for image in page.all("img") if "step_" in (image["alt"] or "")]
    assert [re.findall(r"step_\d+", alt or "") for alt in steps] == [["step_000003"], ["step_000004"]]


def test_a_full_page_says_so(tmp_path):
    for name in ("one", "two"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        Image.effect_noise((1200, 800), 100).save(tmp_path / f"runs/{name}/controls.png")  # about a megabyte of noise
        (tmp_path / f"runs/{name}/run.json").write_text("{}")
    page = Page(written(tmp_path / "runs", tmp_path / "out", "most.megabytes=1"))
    assert (tmp_path / "out/report.html").stat().st_size < 1.1e6
    assert len(page.all("img")) == 1
    assert "the page is full" in page.text


def test_unreadable_files_are_named(command, tmp_path):
    (tmp_path / "runs/x").mkdir(parents=True)
    for name in ("x/scene.json", "x/orbit_00.mp4", "x/sheet.png", "metrics.json"):
        (tmp_path / "runs" / name).write_text("{")
    finished = command("report", "html", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert finished.status == 0
    page = Page((tmp_path / "out/report.html").read_text(encoding="utf-8"))
    assert page.text.count("cannot be shown") == 2
    assert "metrics.json: left out" in page.text


def test_folders_without_anything_and_a_limit_of_nothing_are_refused(tmp_path):
    for folder, message in (("nowhere", "no such folder"), ("", "nothing to show")):
        assert re.match(f"runs=.*{message}", refused("report", "report_task=html", f"runs={tmp_path / folder}"))
    assert refused("report", "report_task=html", "runs=x", "most.frames=0") == "most.frames=0: must be at least 1"
