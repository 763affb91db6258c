"""The page in headless Chromium, without a network, against our rasterizer; needs Node.js too."""

import io
import math
import shutil
from contextlib import contextmanager

import pytest
import torch
from PIL import Image
from support import round_gaussians

from completesplat.export import splat_transform
from completesplat.export.images import to_pixels
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")  # which GitHub's machines have
NODE = shutil.which("npx") or shutil.which("splat-transform")
missing = CHROMIUM is None or NODE is None
pytestmark = [pytest.mark.slow, pytest.mark.skipif(missing, reason="no Chromium or no Node.js")]
WIDTH = 320
HEIGHT = 180
UP = torch.tensor([0.05, -0.92, -0.38])
PIVOT = torch.tensor([0.1, 0.1, 3.0])
REFERENCE = Cameras(torch.eye(4), pinhole(50, 64), (64, 64))


def scene() -> Gaussians:
    """Balls of different colours to the right, to the left, above, and one half hidden by the one on the right."""
    means = torch.tensor([[0.7, 0.0, 3.0], [-0.7, 0.1, 3.0], [0.0, -0.7, 3.0], [0.9, 0.2, 4.0]])
    colors = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]])
    return round_gaussians(means, 0.15, 0.99, colors)


def our_image(view: splat_transform.PageView) -> torch.Tensor:
    fov = splat_transform.viewer_settings(view, splat_transform.upright_rotation(UP))["cameras"][0]["initial"]["fov"]
    assert fov < splat_transform.LARGEST_FOV
    focal = WIDTH / 2 / math.tan(math.radians(fov) / 2)
    intrinsics = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    camera = Cameras(look_at(torch.zeros(3), PIVOT, UP), intrinsics, (HEIGHT, WIDTH))
    image = ReferenceRasterizer()(scene()[None], camera[None, None]).over(view.background)[0, 0]
    return torch.from_numpy(to_pixels(image).copy()).float() / 255


@contextmanager
def opened(path, requests: list[str], options: str = "&noui", width: int = WIDTH, height: int = HEIGHT):
    with playwright.sync_playwright() as started:
        swiftshader = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        browser = started.chromium.launch(executable_path=CHROMIUM, args=swiftshader)
        page = browser.new_context(viewport={"width": width, "height": height}, offline=True).new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.goto(f"{path.as_uri()}?noanim&webgl{options}", timeout=180_000)
        yield page
        browser.close()


def at_rest(page) -> torch.Tensor:
    """The page when something is drawn and nothing moves any more."""
    width = page.viewport_size["width"]
    height = page.viewport_size["height"]
    screenshot = torch.zeros(height, width, 3)
    for _ in range(60):
        page.wait_for_timeout(1000)
        data = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        earlier = screenshot
        screenshot = torch.tensor(list(data.getdata())).view(height, width, 3) / 255
        if screenshot.std() > 0.05 and torch.equal(screenshot, earlier):
            break
    return screenshot


def screenshot(path, requests: list[str]) -> torch.Tensor:
    """The page at rest."""
    with opened(path, requests) as page:
        return at_rest(page)


def test_a_phone_shows_all_that_the_photo_shows(tmp_path, converter):
    """Balls at the photo's left and right edges."""
    means = torch.tensor([[1.2, 0.0, 3.0], [-1.2, 0.0, 3.0], [0.0, 0.0, 3.0]])
    edges = round_gaussians(means, 0.15, 0.99, torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]))
    view = splat_transform.PageView(REFERENCE, means[2], torch.tensor([0.0, -1.0, 0.0]), 0.25)
    splat_transform.write_turning_page(tmp_path / "scene.html", edges, view)
    with opened(tmp_path / "scene.html", [], "", 390, 844) as page:
        seen = at_rest(page)
    areas = [((seen - color).abs() < 0.45).all(-1).sum().item() for color in torch.eye(3)]
    assert min(areas) > 0.9 * max(areas) > 0
    assert place(seen, torch.eye(3)[1]) < 0.5 < place(seen, torch.eye(3)[0])


def test_the_page_draws_what_we_draw_and_asks_for_nothing(tmp_path, converter):
    view = splat_transform.PageView(REFERENCE, PIVOT, UP, 0.25)
    splat_transform.write_turning_page(tmp_path / "scene.html", scene(), view)
    requests: list[str] = []
    theirs = screenshot(tmp_path / "scene.html", requests)
    ours = our_image(view)
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert (theirs - ours).abs().mean() < 0.003
    # So does no other way up, nor the mirror image.
    for other in (theirs.flip(0), theirs.flip(1), theirs.flip(0, 1)):
        assert (other - ours).abs().mean() > 0.01


def place(screenshot: torch.Tensor, color: torch.Tensor) -> float:
    """The mean column, as a share of the width, of what is nearly of this colour."""
    seen = ((screenshot - color).abs() < 0.45).all(-1)
    assert seen.any()
    return seen.nonzero()[:, 1].float().mean().item() / screenshot.shape[1]
