"""The page `notebooks/try` in a browser without a screen: its scenes are those of Python, and it asks nobody else."""

import importlib.util
import shutil
import subprocess
import sys
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler
from io import BytesIO
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from browsers import CHROMIUM, MISSING, started_chromium
from PIL import Image, ImageOps
from support import LIMIT, serving, waited_for

from completesplat.export.ply import read_ply
from completesplat.generator import CompleteSplat
from completesplat.rasterizers.selection import auto
from completesplat.weights import shipped

pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
skimage = pytest.importorskip("skimage", reason="scikit-image is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")
pytest.importorskip("onnxscript", reason="the extra onnx is not installed")

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "notebooks/try"
pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason=MISSING),
    pytest.mark.skipif(shutil.which("npm") is None, reason="Node.js is not installed"),
]
EXIF_TURN = 0x0112
EXIF_EQUIVALENT = 0xA405
MARGINS = 36  # pixels beside the scene's canvas in a narrow page
PHOTOS = ("astronaut", "chelsea", "coffee", "rocket", "motorcycle_left", "color", "camera", "hubble_deep_field")


class Quiet(SimpleHTTPRequestHandler):
    """Handler that does not log requests."""

    def log_message(self, *args: object) -> None: ...


def ran(command: list[str], folder: Path) -> None:
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=LIMIT)
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def model():
    return CompleteSplat.from_pretrained(shipped()["general"])


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A page with the weights `general`."""
    if not (SOURCES / "node_modules").is_dir():
        try:
            ran(["npm", "ci", "--no-audit", "--no-fund"], SOURCES)
        except AssertionError as error:
            pytest.skip(f"npm cannot install the page's packages: {error}")
    folder = tmp_path_factory.mktemp("try")
    arguments = ["weights=general", "precision=float16", f"out={folder / 'weights'}"]
    ran([sys.executable, "-m", "completesplat", "export", *arguments], ROOT)
    shutil.copy(shipped()["general"] / "LICENSE.txt", folder / "weights")
    ran([sys.executable, str(SOURCES / "examples.py"), str(folder / "examples")], ROOT)
    ran(["node", str(SOURCES / "build.mjs"), str(folder)], SOURCES)
    return folder


@pytest.fixture(scope="module")
def address(built):
    with serving(partial(Quiet, directory=str(built))) as address:
        yield address


@pytest.fixture(scope="module")
def chromium():
    with started_chromium() as browser:
        yield browser


@pytest.fixture
def opened(chromium, address):
    """Open the page with a query, and check when the test is over what it asked for and complained of."""
    contexts = []
    requests = []
    errors = []

    def open_page(query: str = "", **settings):  # without motion, because images take long without a graphics card
        context = chromium.new_context(reduced_motion="reduce", **settings)
        context.set_default_timeout(1000 * LIMIT)
        contexts.append(context)
        context.on("request", lambda request: requests.append(request.url))
        tab = context.new_page()
        tab.on("console", lambda message: message.type == "error" and errors.append(message.text))
        tab.on("pageerror", lambda error: errors.append(str(error)))
        begun = time.monotonic()
        tab.goto(f"{address}/{query}")
        assert becomes(tab, "document.body.dataset.networks === 'loaded'")
        print(f"networks loaded after {time.monotonic() - begun:.1f} s")
        return tab

    yield open_page
    for context in contexts:
        context.close()
    strangers = [url for url in requests if urlsplit(url).scheme not in ("blob", "data") and address not in url]
    assert not strangers
    assert not errors


def becomes(tab, state: str) -> bool:
    """Return whether an expression becomes true. The page forbids `eval`, by which playwright itself would wait."""

    def is_so() -> bool:
        tab.wait_for_timeout(200)
        return tab.evaluate(state)

    return waited_for(is_so)


def drop(tab, path: Path) -> None:
    """Drop a file on the page."""
    script = """([bytes, name]) => {
        const transfer = new DataTransfer();
        transfer.items.add(new File([Uint8Array.from(bytes)], name, {type: "image/jpeg"}));
        document.body.dispatchEvent(new DragEvent("drop", {dataTransfer: transfer, bubbles: true, cancelable: true}));
    }"""
    tab.evaluate(script, [list(path.read_bytes()), path.name])


def network_input(tab) -> np.ndarray:
    values = np.array(tab.evaluate("Array.from(tryPage.input)"), dtype=np.float32)
    return values.reshape(3, 128, 128)


def saved_ply(tab, path: Path):
    with tab.expect_download() as download:
        tab.locator("#ply").click()
    download.value.save_as(path)
    return read_ply(path)


def reference(weights: Path, image: np.ndarray, fov_degrees: float, samples: int, seed: int):
    """The scenes of notebooks/onnx_predict.py, which tests/test_onnx.py compares with `predict`."""
    spec = importlib.util.spec_from_file_location("onnx_predict", ROOT / "notebooks/onnx_predict.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Pipeline(weights).scenes(image, fov_degrees, samples, seed)


def test_a_dropped_photo_becomes_the_scenes_of_python(opened, built, model, tmp_path):
    photo = built / "examples/1_coffee.jpg"
    tab = opened("?fit=0&samples=2", accept_downloads=True)
    tab.evaluate("document.getElementById('seed').value = 7")
    begun = time.monotonic()
    drop(tab, photo)
    for sample in range(2):
        assert becomes(tab, f"tryPage.samples.length > {sample}")
        print(f"sample {sample + 1} after {time.monotonic() - begun:.1f} s")
    expected = model.read(photo)
    image = network_input(tab)
    assert abs(image - expected.image.numpy()).max() <= 2 / 255
    scenes = reference(built / "weights", image, expected.fov_degrees, 2, 7)
    for sample, scene in enumerate(scenes):
        tab.locator(".tile").nth(sample).click()
        saved = saved_ply(tab, tmp_path / f"{sample}.ply")
        size = np.ptp(scene["means"], axis=0).max()
        assert abs(saved.means.numpy() - scene["means"]).max() < 1e-3 * size
        assert abs(saved.colors.numpy() - scene["colors"].clip(min=0)).max() < 1 / 255
        assert abs(saved.opacities.numpy() - scene["opacities"]).max() < 1e-3
        assert saved.scales.numpy() == pytest.approx(scene["scales"], rel=1e-2)


def canvas_pixels(tab, side: int) -> torch.Tensor:
    """What the canvas of the scene shows in the photo's view, [3, side, side]."""
    assert becomes(tab, f"document.getElementById('scene').width === {side}")  # drawn
    tab.evaluate("for (const id of ['frame', 'scene']) document.getElementById(id).style.borderRadius = 0")
    image = Image.open(BytesIO(tab.locator("#scene").screenshot())).convert("RGB")
    return torch.from_numpy(np.array(image)).movedim(-1, 0) / 255


@pytest.mark.parametrize(("name", "side", "least"), [("2_cat", 256, 29.5), ("3_apple", 128, 27.0)])
def test_the_front_of_a_scene_looks_like_the_photo(opened, built, model, tmp_path, name, side, least):
    """The canvas has the size of the image that the front is fitted to, so that both rasterizers draw the same."""
    tab = opened("?samples=1", accept_downloads=True, viewport={"width": side + MARGINS, "height": 700})
    tab.locator("#examples button").nth(int(name[0]) - 1).click()
    assert becomes(tab, "tryPage.samples.length > 0")
    saved = saved_ply(tab, tmp_path / "fitted.ply")
    shown = canvas_pixels(tab, side)
    read = model.read(built / f"examples/{name}.jpg")
    assert tab.evaluate("tryPage.photo.fitSize") == side
    camera = model.camera(read, side)
    rendered = auto()(saved[None], camera[None][None]).over(0.5)[0, 0].clamp(0, 1)
    own = read.own_at(side)
    if own is None:  # the photo is square
        own = torch.ones(1, side, side)
    difference = (rendered - read.square_at(side)).square() * own
    decibels = -10 * torch.log10(difference.sum() / (3 * own.sum())).item()
    alike = -10 * torch.log10((shown - rendered).square().mean()).item()
    print(f"{name}: {decibels:.1f} dB from the rasterizer to the photo, {alike:.1f} dB to the canvas")
    assert decibels > least
    assert alike > 45


def test_photos_are_read_as_by_python(opened, model, tmp_path):
    data = Path(skimage.__file__).parent / "data"
    paths = [next(data.glob(f"{name}.*")) for name in PHOTOS]
    cat = Image.open(data / "chelsea.png").convert("RGB")
    exif = Image.Exif()
    exif[EXIF_TURN] = 6
    exif.get_ifd(0x8769)[EXIF_EQUIVALENT] = 28
    cat.save(tmp_path / "portrait.jpg", exif=exif)
    cat.resize((900, 200)).save(tmp_path / "panorama.jpg")
    cut = cat.convert("RGBA")
    cut.putalpha(ImageOps.invert(cat.convert("L")).point(lambda value: 255 if value > 100 else 0))
    cut.save(tmp_path / "transparent.png")
    cat.resize((4032, 3024)).save(tmp_path / "phone.jpg")
    paths += [tmp_path / name for name in ("portrait.jpg", "panorama.jpg", "transparent.png", "phone.jpg")]
    tab = opened()
    for path in paths:
        tab.locator("#file").set_input_files(path)
        assert becomes(tab, "tryPage.input !== null"), path
        expected = model.read(path)
        difference = abs(network_input(tab) - expected.image.numpy()).max()
        print(f"{path.name}: {255 * difference:.2f} / 255")
        assert difference <= 2 / 255, path
        assert tab.evaluate("tryPage.photo.fovDegrees") == pytest.approx(expected.fov_degrees, abs=1e-3)
        tab.locator("#cancel").click()


def test_what_is_no_photo_is_refused_in_words(opened, tmp_path):
    tab = opened()
    files = {"text.txt": b"no photo", "cut.jpg": b"\xff\xd8\xff\xe0", "empty.png": b"", "phone.heic": b"\0" * 100}
    words = {"text.txt": "not an image", "cut.jpg": "not an image", "empty.png": "empty", "phone.heic": "HEIC"}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        tab.locator("#file").set_input_files(tmp_path / name)
        tab.get_by_role("alert").filter(has_text=words[name]).wait_for(timeout=1000 * LIMIT)
    Image.new("RGB", (4, 400)).save(tmp_path / "thin.png")
    tab.locator("#file").set_input_files(tmp_path / "thin.png")
    tab.get_by_role("alert").filter(has_text="4 x 400").wait_for(timeout=1000 * LIMIT)
    Image.new("L", (9000, 9000)).save(tmp_path / "huge.png")
    tab.locator("#file").set_input_files(tmp_path / "huge.png")
    tab.get_by_role("alert").filter(has_text="81 million").wait_for(timeout=1000 * LIMIT)


def test_the_page_works_offline_once_it_is_loaded(opened):
    tab = opened("?samples=1")
    assert becomes(tab, "!document.getElementById('offline').hidden")
    tab.context.set_offline(True)
    tab.reload()
    assert becomes(tab, "document.body.dataset.networks === 'loaded'")
    tab.locator("#examples button").first.click()
    assert becomes(tab, "tryPage.samples.length > 0")
