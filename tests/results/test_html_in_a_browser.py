"""The page in Chromium: it fits phone and desktop, asks for nothing, and its samples turn."""

import io
import shutil

import numpy as np
import pytest
from PIL import Image
from report_pages import FRAMES, grey, write_results

from completesplat.results.html_page import page

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
MOST = {"frames": FRAMES, "samples": 8, "predictions": 8, "runs": 8, "images": 8, "megabytes": 40}
SIZES = {"phone": (390, 844), "desktop": (1440, 900)}

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    write_results(folder)
    text, _ = page(folder, folder / "out", MOST, {})
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install playwright"
    )
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as running:
        started = running.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(params=SIZES)
def opened(request, browser, file):
    """The page with everything unfolded, and what went wrong and was asked for meanwhile."""
    width, height = SIZES[request.param]
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=True, offline=True)
    shown, complaints = context.new_page(), []
    shown.on("console", lambda message: complaints.append(message.text))
    shown.on("pageerror", lambda error: complaints.append(str(error)))
    shown.on("request", lambda asked: asked.url.startswith(("data:", file.as_uri())) or complaints.append(asked.url))
    shown.goto(file.as_uri())
    shown.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    yield shown
    assert complaints == []
    context.close()


def level(shown, index: int = 0) -> float:
    """Return the mean value in the middle of the frame that a sample shows."""
    png = shown.locator(".turntable").nth(index).screenshot()
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("L"), dtype=float)
    height, width = pixels.shape
    return pixels[height // 4 : -height // 4, width // 4 : -width // 4].mean().item()


def test_nothing_is_wider_than_the_page_and_all_images_are_drawn(opened):
    width, window = opened.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert width <= window
    scrolled = "[...document.querySelectorAll('.scroll')].some(box => box.scrollWidth > box.clientWidth)"
    assert opened.evaluate(scrolled)  # so there was something too wide
    assert opened.evaluate("Promise.all([...document.images].map(image => image.decode())).then(() => true)")


def place(shown, index: int, frame: int) -> tuple[float, float]:
    """Return the point of a sample that shows a frame when it is touched."""
    box = shown.locator(".turntable").nth(index)
    box.scroll_into_view_if_needed()
    size = box.bounding_box()
    return size["x"] + size["width"] * (frame + 0.5) / FRAMES, size["y"] + size["height"] / 2


def test_mouse_and_finger_turn_all_samples_of_a_scene(opened):
    for frame in (0, 5, FRAMES - 1):
        opened.mouse.move(*place(opened, 1, frame))
        for sample in range(3):
            assert level(opened, sample) == pytest.approx(255 * grey(sample, frame), abs=8)
    opened.touchscreen.tap(*place(opened, 0, 7))
    assert opened.locator(".turntable").first.get_attribute("aria-valuenow") == "7"


def test_the_keyboard_turns_them_too(opened):
    box, last = opened.locator(".turntable").first, FRAMES - 1
    box.focus()
    for key, expected in {"ArrowRight": 1, "Home": 0, "ArrowLeft": last, "End": last}.items():
        box.press(key)
        assert box.get_attribute("aria-valuenow") == str(expected)
    assert level(opened) == pytest.approx(255 * grey(0, last), abs=8)
