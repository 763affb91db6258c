"""`completesplat report html`: one page, of which nothing outside is asked, with all that was found."""

import io
import re
from base64 import b64decode
from pathlib import Path

import pytest
from PIL import Image
from report_pages import FRAMES, HOSTILE, SAMPLES, Page, grey, picture, write_results
from support import compose_config, refused

from completesplat.commands.jobs import start
from completesplat.results.html_page import strip


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    write_results(root)
    return root


def written(runs: Path, out: Path, *settings: str) -> str:
    out.mkdir(exist_ok=True)
    config = compose_config("report", "report_task=html", f"runs={runs}", *settings)
    start("report", config, out)
    return (out / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def raw(results, tmp_path_factory):
    return written(results, tmp_path_factory.mktemp("page"), "most.frames=6")


@pytest.fixture(scope="module")
def page(raw):
    return Page(raw)


def decoded(uri: str) -> Image.Image:
    return Image.open(io.BytesIO(b64decode(uri.partition("base64,")[2])))


def strips(page: Page) -> list[dict]:
    return [image for image in page.all("img") if "seen from" in (image["alt"] or "")]


def test_the_page_asks_for_nothing(page):
    assert page.open == []
    for name, attributes in page.elements:
        assert name not in ("link", "iframe", "object", "embed", "base", "form", "video")
        for attribute in ("src", "href", "srcset", "data", "poster", "action"):
            assert (attributes.get(attribute) or "#").startswith(("data:image/", "#")), (name, attributes)
        assert not any(attribute.startswith("on") for attribute in attributes)
    (policy,) = page.all("meta", http_equiv="Content-Security-Policy")
    assert (policy["content"] or "").startswith("default-src 'none';")
    assert len(page.all("script")) == len(page.all("style")) == 1


def test_its_own_styles_and_scripts_ask_for_nothing(raw):
    for own in re.findall(r"<(?:style|script)>(.*?)</", raw, re.DOTALL):
        assert not re.search(r"https?:|url\(|@import|fetch|import\(", own)


def test_names_are_text_whatever_they_hold(page):
    assert page.text.count(HOSTILE) >= 4  # the run, its settings, its method in a table, and its figures
    assert not any("onerror" in attributes for _, attributes in page.elements)
    assert any(HOSTILE in (image["alt"] or "") for image in page.all("img"))


def test_every_run_and_what_it_did_is_there(page):
    assert len(page.all("details", class_="run")) == 3
    for said in ("21.12", "0.875", "17.25", "completesplat fit 'a=b c'", "c0ffee", "2026-11-21", "Table 2"):
        assert said in page.text, said


def test_every_sample_turns_as_its_video_does(page):
    boxes, images = page.all("div", class_="turntable"), strips(page)
    assert len(boxes) == len(images) == SAMPLES
    for sample, (box, image) in enumerate(zip(boxes, images, strict=True)):
        assert (box["data-frames"], box["role"], box["tabindex"]) == ("6", "slider", "0")
        strip = decoded(image["src"]).convert("L")
        side = strip.width // 6
        assert strip.height == side
        for frame in range(6):
            middle = strip.getpixel((frame * side + side // 2, side // 2))
            assert middle == pytest.approx(255 * grey(sample, frame * FRAMES // 6), abs=6)


def test_a_short_video_gives_all_its_frames(results):
    image, frames = strip(results / "predictions/x/orbit_00.mp4", 48)
    assert frames == FRAMES
    assert image.width == FRAMES * image.height


def test_every_picture_says_what_it_is(page):
    assert all(image["alt"] for image in page.all("img"))
    assert all(box["aria-label"] for box in page.all("div", class_="scroll"))


def test_wide_pictures_are_made_smaller(page):
    (figure,) = [image for image in page.all("img") if "hidden_modes" in (image["alt"] or "")]
    assert decoded(figure["src"]).size == (1600, 40)


def test_what_does_not_fit_is_left_out_and_counted(results, tmp_path):
    page = Page(written(results, tmp_path, "most.pictures=2", "most.samples=1", "most.runs=2"))
    assert "3 more in" in page.text
    assert "2 more samples left out" in page.text
    assert "1 more runs left out" in page.text
    steps = [image["alt"] for image in page.all("img") if "step_" in (image["alt"] or "")]
    assert [re.findall(r"step_\d+", alt or "") for alt in steps] == [["step_000003"], ["step_000004"]]


def test_a_full_page_says_so(tmp_path):
    for name in ("one", "two"):
        Image.effect_noise((1200, 800), 100).save(tmp_path / f"{name}.png")  # about a megabyte of noise
        picture(tmp_path / f"runs/{name}/controls.png", 0)
        (tmp_path / f"{name}.png").replace(tmp_path / f"runs/{name}/controls.png")
        (tmp_path / f"runs/{name}/run.json").write_text("{}")
    page = Page(written(tmp_path / "runs", tmp_path / "out", "most.megabytes=1"))
    assert (tmp_path / "out/report.html").stat().st_size < 1.1e6
    assert len(page.all("img")) == 1
    assert "the page is full" in page.text


def test_what_cannot_be_read_is_named(command, tmp_path):
    (tmp_path / "runs/x").mkdir(parents=True)
    (tmp_path / "runs/x/scene.json").write_text("no JSON")
    (tmp_path / "runs/x/orbit_00.mp4").write_bytes(b"no video")
    (tmp_path / "runs/x/sheet.png").write_bytes(b"no picture")
    (tmp_path / "runs/metrics.json").write_text("{")
    finished = command("report", "html", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert finished.status == 0
    page = Page((tmp_path / "out/report.html").read_text(encoding="utf-8"))
    assert page.text.count("cannot be shown") == 2
    assert "metrics.json: left out" in page.text


@pytest.mark.parametrize(("folder", "said"), [("nowhere", "no such folder"), ("", "nothing to show")])
def test_a_folder_without_anything_is_refused(tmp_path, folder, said):
    line = refused("report", "report_task=html", f"runs={tmp_path / folder}")
    assert line.startswith("runs=")
    assert said in line


def test_a_limit_of_nothing_is_refused():
    assert refused("report", "report_task=html", "runs=x", "most.frames=0") == "most.frames=0: must be at least 1"
