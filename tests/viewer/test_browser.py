"""The page in a browser: Debian's Chromium without a screen, which draws WebGL on the CPU (SwiftShader)."""

import base64
import io
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from browsers import CHROMIUM, MISSING, started_chromium
from PIL import Image
from support import LIMIT, tiny_generator, waited_for
from viewer_scenes import BALLS, START, balls_sample

from completesplat.export.splat import write_splat
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from completesplat.viewer.access import show_status, start_server  # noqa: E402
from completesplat.viewer.completion import Completion  # noqa: E402
from completesplat.viewer.page import Page, Saver, write_viewer_page  # noqa: E402
from completesplat.viewer.panel import square_text  # noqa: E402
from completesplat.viewer.splat_view import MARGIN, SplatView  # noqa: E402
from completesplat.viewer.turning import REST  # noqa: E402

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason=MISSING),
]
WINDOW = {"width": 700, "height": 360}
GREY = 128


@pytest.fixture(scope="module")
def chromium():
    with started_chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    server = start_server(0)
    view = SplatView(server, (0.0, -1.0, 0.0))
    view.show([balls_sample()])
    saver = Saver(tmp_path_factory.mktemp("saved"), view, ReferenceRasterizer, 2, 0.5)
    made = Page(server, view, saver, {})
    made.completion = Completion(made, tiny_generator(), START | {"samples": 1})
    yield made
    made.close()


def open_tab(chromium, address: str, window: dict[str, int] = WINDOW):
    tab = chromium.new_page(viewport=window)
    tab.errors = []
    note = tab.errors.append
    tab.on("console", lambda message: message.type == "error" and note(message.text))
    tab.on("pageerror", lambda error: tab.errors.append(str(error)))
    tab.goto(address)
    assert waited_for(lambda: abs(settled(tab)[-5, 5] - GREY).max() < 3), "the page does not appear"
    # The notices (that there is no graphics card, and others) would cover the scene.
    tab.add_style_tag(content=".mantine-Notification-root { visibility: hidden }")
    return tab


@pytest.fixture(scope="module")
def tab(chromium, page):
    return open_tab(chromium, page.server.address)


def pixels(tab) -> np.ndarray:
    """The scene's part of the window, [height width 3]."""
    tab.locator("canvas").first.wait_for(timeout=1000 * LIMIT)
    canvas = max(tab.locator("canvas").all(), key=lambda c: c.bounding_box()["width"])
    return np.asarray(Image.open(io.BytesIO(canvas.screenshot(timeout=1000 * LIMIT))).convert("RGB")).astype(float)


def settled(tab) -> np.ndarray:
    """The scene when the page has faded in from white, and nothing moves any more."""
    shots = [pixels(tab)]

    def still() -> bool:
        shots.append(pixels(tab))
        return shots[-1].mean() < 200 and abs(shots[-1] - shots[-2]).max() < 2

    assert waited_for(still), "the image does not come to rest"
    return shots[-1]


def changed(tab, before: np.ndarray) -> np.ndarray:
    assert waited_for(lambda: abs(pixels(tab) - before).max() > 20), "the image stays the same"
    return settled(tab)


def turn(tab, before: np.ndarray) -> np.ndarray:
    """Drag the scene to the side."""
    x = before.shape[1] / 2
    y = before.shape[0] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 60, y, steps=5)
    tab.mouse.up()
    return changed(tab, before)


def ours(height: int, width: int, shrink: int) -> np.ndarray:
    """The balls by our own rasterizer: what the reference camera and the margin around it show in such a window."""
    focal = min(height, width) / 2 / np.tan(np.radians(25)) / MARGIN
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]) / shrink
    intrinsics[2, 2] = 1
    camera = Cameras(torch.eye(4), intrinsics.float(), (height // shrink, width // shrink))
    rendering = ReferenceRasterizer()(balls_sample().gaussians[None], camera[None][None])
    return rendering.over(GREY / 255)[0, 0].permute(1, 2, 0).clamp(0, 1).numpy() * 255


def shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    height, width = (size // factor * factor for size in image.shape[:2])
    return image[:height, :width].reshape(height // factor, factor, width // factor, factor, 3).mean((1, 3))


def place(image: np.ndarray, color: tuple[float, float, float]) -> tuple[float, float]:
    """The middle (row, column) of what is nearly of this colour."""
    places = np.argwhere(abs(image - 255 * np.array(color)).max(-1) < 40)
    assert len(places), f"nothing of the colour {color}"
    return tuple(places.mean(axis=0))


def agrees(seen: np.ndarray, pixels: float = 1) -> bool:
    """Return whether each ball is where our own rasterizer draws it, within pixels of an image a third as large."""
    expected = ours(*seen.shape[:2], shrink=3)
    actual = shrunk(seen, 3)
    places = [(place(actual, color), place(expected, color)) for _, color in BALLS.values()]
    return all(one == pytest.approx(other, abs=pixels) for one, other in places)


def test_the_page_draws_the_splats_as_our_rasterizer_does_and_has_our_title_and_icon_and_no_errors(tab):
    seen = settled(tab)
    assert agrees(seen)
    assert np.corrcoef(shrunk(seen, 3).ravel(), ours(*seen.shape[:2], shrink=3).ravel())[0, 1] > 0.97
    assert tab.title() == "completesplat"
    assert "1971c2" in tab.locator("link[rel=icon]").get_attribute("href")
    assert tab.errors == []


def test_a_wide_window_shows_more_than_the_photo_above_and_below_and_the_whole_title(chromium, page):
    """The balls reach the photo's upper edge."""
    camera = replace(balls_sample().reference, intrinsics=pinhole(28.0, 64))
    page.show([replace(balls_sample(), reference=camera)])
    wide = open_tab(chromium, page.server.address, {"width": 1440, "height": 900})
    seen = settled(wide)
    green = abs(seen - 255 * np.array(BALLS["green"][1])).max(-1) < 40
    assert green.any()
    assert not green[0].any()
    show_status(page.server, "3 drawn in 79.7 s")
    title = wide.get_by_text("completesplat: 3 drawn in 79.7 s")
    assert title.evaluate("title => title.scrollWidth <= title.clientWidth"), "the title is cut"
    wide.close()
    page.show([balls_sample()])


def test_a_phone_shows_the_whole_scene_and_the_panel_when_it_is_wanted(chromium, page):
    phone = open_tab(chromium, page.server.address, {"width": 390, "height": 700})
    button = phone.get_by_role("button", name="Load a file")
    assert not button.is_visible()
    seen = settled(phone)
    assert seen.shape[:2] == (700, 390)
    assert agrees(seen, 1.5)
    title = phone.get_by_text("completesplat", exact=True)
    assert "tap for the controls" in title.evaluate("title => getComputedStyle(title, '::after').content")
    title.click()
    button.wait_for(timeout=1000 * LIMIT)
    assert phone.errors == []
    phone.close()


def test_a_tile_makes_its_sample_large_and_a_key_shows_all(tab, page):
    first = balls_sample()
    second = balls_sample()
    second.gaussians.colors[:] = torch.tensor(BALLS["yellow"][1])
    before = settled(tab)
    page.show([first, second])
    tab.get_by_role("button", name="sample 2").click(timeout=1000 * LIMIT)
    one = changed(tab, before)
    assert page.view.chosen == 1
    assert not (abs(one - 255 * np.array(BALLS["red"][1])).max(-1) < 40).any()
    tab.locator("canvas").first.press("0")
    both = changed(tab, one)
    assert place(both, BALLS["red"][1])[1] < both.shape[1] / 2  # of the first sample, on the left
    tab.locator("canvas").first.press("1")
    changed(tab, both)
    assert page.view_controls.chosen.value == "sample 1"
    page.show([first])


def test_an_upload_gives_a_sample_and_another_seed_another(tab, page, tmp_path):
    file = tmp_path / "photo.png"
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (4, 4, 3), np.uint8)).resize((64, 64)).save(file)
    before = settled(tab)
    turned = turn(tab, before)
    client = page.server.get_clients()[min(page.server.get_clients())]  # the tab, which came first
    assert abs(client.camera.position).max() > 0.3
    with tab.expect_file_chooser() as chooser:
        tab.get_by_role("button", name="Load a file").click()
    chooser.value.set_files(file)
    tab.get_by_text("1 drawn in").wait_for(timeout=1000 * LIMIT)
    first = changed(tab, turned)
    assert page.view.samples[0].settings["image"] == "photo.png"
    assert client.camera.position == pytest.approx(np.zeros(3), abs=0.02)  # it comes back to the front
    assert client.camera.look_at[:2] == pytest.approx(np.zeros(2), abs=0.02)
    number = "xpath=following::input[contains(@class, 'mantine-NumberInput-input')][1]"
    tab.get_by_role("button", name="Advanced").press("Enter")  # folded until then
    seed = tab.get_by_text("Seed", exact=True).locator(number)
    seed.fill("9")
    seed.press("Enter")
    tab.get_by_role("button", name="Draw again").click()
    assert waited_for(lambda: page.view.samples[0].settings.get("seed") == 9), "no new sample"
    changed(tab, first)


def test_a_square_is_dragged_on_the_photo(tab, page, tmp_path):
    """From its lower right corner to a point further left and higher."""
    file = tmp_path / "wide.png"
    Image.effect_noise((128, 64), 80).convert("RGB").save(file)
    completion = page.completion
    with tab.expect_file_chooser() as chooser:
        tab.get_by_role("button", name="Load a file").click()
    chooser.value.set_files(file)
    assert waited_for(lambda: page.view.samples[0].settings.get("image") == "wide.png"), "no samples"
    completion.controls.crop.value = "square"
    photo = tab.get_by_alt_text("the whole photo")
    photo.scroll_into_view_if_needed(timeout=1000 * LIMIT)
    box = photo.bounding_box()
    tab.mouse.move(box["x"] + box["width"] - 1, box["y"] + box["height"] - 1)
    tab.mouse.down()
    tab.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] * 0.6, steps=3)
    tab.mouse.up()
    assert waited_for(lambda: completion.crop != "whole"), "the square does not arrive"
    assert completion.crop == pytest.approx((0.75, 0.5, 0.5), abs=0.02)
    assert waited_for(lambda: completion.photo[1].window[2] - completion.photo[1].window[0] < 34)
    field = tab.get_by_role("textbox", name="Square")
    assert waited_for(lambda: field.input_value() == square_text(completion.crop)), "the page does not show it"
    field.fill("0, 0, 1")
    field.press("Enter")
    assert waited_for(lambda: completion.photo[1].window == (0, 0, 64, 64)), "what is typed does not arrive"
    completion.controls.crop.value = "whole"
    assert waited_for(lambda: completion.photo[1].window == (0, -32, 128, 96))
    assert tab.errors == []


@pytest.fixture
def empty(tmp_path):
    server = start_server(0)
    view = SplatView(server, (0.0, -1.0, 0.0))
    made = Page(server, view, Saver(tmp_path / "saved", view, ReferenceRasterizer, 2, 0.5), {})
    Completion(made, tiny_generator(), START | {"samples": 1})
    show_status(server, "")
    yield made
    made.close()


def test_an_empty_page_asks_for_a_photo_and_then_turns_its_scene_until_it_is_touched(chromium, empty, tmp_path):
    file = tmp_path / "photo.png"
    Image.effect_noise((64, 64), 80).convert("RGB").save(file)
    tab = open_tab(chromium, empty.server.address)
    tab.set_default_timeout(1000 * LIMIT)
    tab.get_by_role("dialog", name="Drop a photo here").wait_for()
    assert not tab.get_by_text("Drawing the first image").is_visible()
    assert tab.get_by_role("button", name="Draw again", include_hidden=True).is_disabled()
    assert tab.get_by_role("button", name="Save", exact=True, include_hidden=True).is_disabled()
    with tab.expect_file_chooser() as chooser:
        tab.get_by_role("button", name="Choose a photo").click()
    chooser.value.set_files(file)
    tab.get_by_role("dialog").wait_for(state="detached")
    tab.get_by_role("status").filter(has_text="1 drawn in").wait_for()
    slider = tab.get_by_role("slider", name="photo on the left, scene on the right")
    slider.press("ArrowRight")
    assert slider.evaluate("slider => slider.parentNode.style.getPropertyValue('--cut')") == "51%"
    tab.get_by_role("slider", name="Samples").wait_for()
    assert not tab.get_by_text("Skip weight").is_visible()
    (client,) = empty.server.get_clients().values()
    front = client.camera.position.copy()
    empty.turntable.step(0)
    empty.turntable.step(REST + 1)
    assert waited_for(lambda: abs(client.camera.position - front).max() > 0.01), "the scene stands still"
    tab.mouse.move(200, 200)
    tab.mouse.down()
    tab.mouse.up()
    assert waited_for(lambda: empty.turntable.has_stopped(client.client_id)), "a touch does not stop it"
    assert tab.errors == []
    tab.close()


DROP = """([name, content]) => {
    const data = new DataTransfer();
    data.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
    const drop = new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true });
    document.querySelector("canvas").dispatchEvent(drop);
    return drop.defaultPrevented;
}"""


def test_a_scene_that_is_dropped_on_the_page_is_shown(tab, page, tmp_path):
    page.show([balls_sample()])
    before = settled(tab)
    write_splat(tmp_path / "red.splat", replace(balls_sample().gaussians, colors=torch.tensor([[0.9, 0.1, 0.1]] * 600)))
    content = base64.b64encode((tmp_path / "red.splat").read_bytes()).decode()
    assert tab.evaluate(DROP, ["red.splat", content]), "the browser would open the file itself"
    assert waited_for(lambda: page.view.samples[0].layers == 1), "nothing arrives"
    seen = changed(tab, before)
    assert place(seen, BALLS["red"][1])
    assert not (abs(seen - 255 * np.array(BALLS["blue"][1])).max(-1) < 40).any()
    tab.get_by_text("completesplat: red.splat").wait_for(timeout=1000 * LIMIT)


def test_a_phone_says_what_it_waits_for(chromium, page, monkeypatch):
    waiting = threading.Event()
    monkeypatch.setattr(viser.ClientHandle, "get_render", lambda *_, **__: waiting.wait(LIMIT))
    phone = chromium.new_page(viewport={"width": 390, "height": 700})
    phone.set_default_timeout(1000 * LIMIT)
    html = phone.goto(page.server.address).text()
    assert "completesplat: starting the page" in html  # until viser's program has started
    phone.get_by_text("Drawing the first image").wait_for()
    show_status(page.server, "drawing from photo.png")
    phone.get_by_text("completesplat: drawing from photo.png").wait_for()
    waiting.set()
    phone.get_by_text("Drawing the first image").wait_for(state="detached")
    phone.close()


def test_the_offline_page_draws_the_splats(chromium, page, tmp_path):
    page.show([balls_sample()])
    write_viewer_page(page.server, tmp_path / "page.html")
    offline = open_tab(chromium, f"file://{tmp_path / 'page.html'}")
    seen = settled(offline)
    assert agrees(seen)
    assert offline.errors == []
    around = turn(offline, seen)  # about the red ball
    assert place(around, BALLS["red"][1]) == pytest.approx(place(seen, BALLS["red"][1]), abs=8)
    assert abs(place(around, BALLS["yellow"][1])[1] - place(seen, BALLS["yellow"][1])[1]) > 8
