"""The page without a browser: what its controls do to the scene, and what is sent to those who look."""

import io
import logging
import os
import threading
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import fake_converter
import numpy as np
import pytest
import torch
from PIL import Image
from support import LIMIT, tiny_generator
from viewer_scenes import SETTINGS, START, balls_sample

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import with_screen_space_dilation
from completesplat.export.description import write_scene_json
from completesplat.export.images import to_pixels
from completesplat.export.mesh import Mesh
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.splat import write_splat
from completesplat.geometry.cameras import look_at
from completesplat.rasterizers.reference import ReferenceRasterizer

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")

from completesplat.viewer import completion as completion_module  # noqa: E402
from completesplat.viewer import page as page_module  # noqa: E402
from completesplat.viewer.access import start_server  # noqa: E402
from completesplat.viewer.completion import Completion  # noqa: E402
from completesplat.viewer.page import Page, Saver  # noqa: E402
from completesplat.viewer.panel import SIDE_BY_SIDE, comparison, sample_tiles  # noqa: E402
from completesplat.viewer.photo_file import PhotoFile  # noqa: E402
from completesplat.viewer.splat_view import SplatView  # noqa: E402


class Browser(viser.ClientHandle):
    """Stands in for one that is connected: keeps what it is sent."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.files: dict[str, bytes] = {}
        self.camera = SimpleNamespace(image_width=0, image_height=0)

    def atomic(self) -> nullcontext:
        return nullcontext()

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.messages.append(body)

    def send_file_download(self, name: str, content: bytes) -> None:
        self.files[name] = content


@pytest.fixture(scope="module")
def model():
    return tiny_generator()


@pytest.fixture(scope="module")
def server():
    made = start_server(0)
    yield made
    made.stop()


@pytest.fixture
def page(server, tmp_path, monkeypatch):
    monkeypatch.setattr(page_module, "THUMBNAIL", 8)  # of 96 pixels they take most of the time
    server.scene.reset()
    server.gui.reset()
    view = SplatView(server, (0.0, -1.0, 0.0))
    view.show([balls_sample()])
    made = Page(server, view, Saver(tmp_path / "out", view, ReferenceRasterizer, 2, 0.5), {})
    yield made
    made.worker.close()


@pytest.fixture
def completion(page, model):
    return Completion(page, model, START)


def finish(page: Page) -> list:
    """Return the samples on the page when no job is left."""
    assert page.worker.wait(LIMIT)
    return page.view.samples


def press(page: Page, button, browser: Browser | None = None, wait: bool = True) -> list:
    for callback in button._impl.update_cb:
        callback(viser.GuiEvent(client=browser or Browser(), client_id=0, target=button))
    return finish(page) if wait else []


def png(width: int = 40, height: int = 40, mode: str = "RGB") -> bytes:
    Image.new(mode, (width, height), 1 if mode == "1" else (128, 50, 200)).save(buffer := io.BytesIO(), "PNG")
    return buffer.getvalue()


def load(page: Page, name: str = "photo.png", content: bytes | None = None, browser: Browser | None = None) -> list:
    """Upload a file, and return the samples on the page when no job is left."""
    page.file_controls.upload._impl.value = SimpleNamespace(name=name, content=content or png())
    return press(page, page.file_controls.upload, browser)


def nodes(page: Page) -> dict[str, object]:
    return page.view._splats


def test_layers_are_switched_and_samples_chosen_and_placed(page):
    page.show([balls_sample(layers=4), balls_sample(layers=2)])
    first, second = ({f"/sample_{i}/layer_{j}": 600 // of for j in range(of)} for i, of in enumerate((4, 2)))
    assert {name: len(node.centers) for name, node in nodes(page).items()} == dict.fromkeys(list(first), 150)
    page.view_controls.chosen.value = SIDE_BY_SIDE
    assert nodes(page).keys() == (first | second).keys()
    page.view_controls.layers[1].value = False
    hidden = {name for name, node in nodes(page).items() if not node.visible}
    assert hidden == {"/sample_0/layer_1", "/sample_1/layer_1"}
    page.view_controls.layers[1].value = True
    assert all(node.visible for node in nodes(page).values())
    assert len({tuple(node.position) for node in nodes(page).values()}) == 2
    page.view_controls.chosen.value = "sample 2"
    assert {name: len(node.centers) for name, node in nodes(page).items()} == dict.fromkeys(list(first)[:2], 300)
    assert {tuple(node.position) for node in nodes(page).values()} == {(0.0, 0.0, 0.0)}


def test_keys_and_thumbnails_choose_a_sample(page):
    page.show([balls_sample()] * 3)
    finish(page)
    thumbnails = page.view_controls.tiles
    assert thumbnails.content.count("<img") == 3
    assert "key:'3'" in thumbnails.content
    first = thumbnails.content
    keys = ("2", 1, "sample 2"), ("4", 1, "sample 2"), ("9", 1, "sample 2"), ("0", None, SIDE_BY_SIDE)
    for digit, chosen, value in keys:
        for callback in page.view_controls.keys[digit]._impl.trigger_cb:
            callback(viser.CommandEvent(client=Browser(), client_id=0, target=page.view_controls.keys[digit]))
        assert (page.view.chosen, page.view_controls.chosen.value) == (chosen, value)
    assert len({tuple(node.position) for node in nodes(page).values()}) == 3
    assert thumbnails.content != first  # none is marked
    page.show([balls_sample()])
    finish(page)
    assert thumbnails.content == ""


def test_a_thumbnail_is_a_view_from_behind_where_samples_differ(page):
    """The camera on the other side of the pivot, which looks back."""
    sample = balls_sample()
    wide = replace(sample.reference, image_size=(64, 96))
    image = page.saver.thumbnail(replace(sample, reference=wide), 48)
    assert image.shape == (32, 48, 3)
    behind = look_at(torch.tensor([0.0, 0, 2 * sample.pivot()[2]]), sample.pivot(), torch.tensor([0.0, -1, 0]))
    camera = replace(sample.reference, world_to_camera=behind)
    rendering = ReferenceRasterizer()(sample.gaussians[None], camera[None][None]).over(0.5)
    ours = to_pixels(rendering[0, 0]).reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert abs(image[:, :32] - ours).mean() < 6


def test_the_photo_of_a_predictions_folder_is_in_the_panel_and_a_damaged_one_refused(page, tmp_path):
    write_ply(tmp_path / "scene.ply", balls_sample().gaussians)
    (tmp_path / "photo.png").write_bytes(b"of someone else")
    page.open(tmp_path, "scene")
    write_scene_json(tmp_path / "scene.json", balls_sample().reference, {}, 0, {})
    for content, shown in ((png(), True), (None, False), (b"no image", None)):
        (tmp_path / "photo.png").unlink(missing_ok=True)
        if content is not None:
            (tmp_path / "photo.png").write_bytes(content)
        with nullcontext() if shown is not None else pytest.raises(CompleteSplatError, match=r"photo\.png: not an im"):
            page.open(tmp_path, "scene")
        assert ("the photo" in page.view_controls.photo.content) == bool(shown)
        finish(page)
        assert ("the scene" in page.view_controls.photo.content) == bool(shown)


def test_depth_replaces_colours_and_frusta_stand_at_the_cameras(page):
    red = nodes(page)["/sample_0/layer_0"].rgbs.copy()
    for depth in (True, False):
        page.view_controls.depth.value = depth
        assert (nodes(page)["/sample_0/layer_0"].rgbs == red).all() == (not depth)
    page.view_controls.cameras["orbit"].value = True
    frusta = page.view._frusta
    assert frusta[0].position == pytest.approx(np.zeros(3), abs=1e-5)  # the orbit starts at the reference camera
    middle = np.stack([f.position for f in frusta]).mean(axis=0)
    assert middle == pytest.approx(page.view.samples[0].pivot().numpy(), abs=1e-4)
    assert frusta[0].fov == pytest.approx(np.radians(50), abs=1e-5)
    page.view_controls.cameras["orbit"].value = False
    assert page.view._frusta == []


def titles(page: Page, monkeypatch) -> list[str]:
    """What the title of the panel says from now on: all that a phone shows of its folded panel."""
    said = []
    monkeypatch.setattr(page.server.gui, "set_panel_label", said.append)
    return said


def test_an_uploaded_image_is_completed_as_by_the_model_and_shown_forming(completion, model, monkeypatch):
    monkeypatch.setattr("completesplat.viewer.completion.PAUSE", 0)
    said = titles(completion.page, monkeypatch)
    seen = []
    show = completion.page.show
    monkeypatch.setattr(completion.page, "show", lambda samples, text: seen.append(samples[0]) or show(samples, text))
    samples = load(completion.page)
    for sample, expected in zip(samples, model(completion.photo[1], **SETTINGS), strict=True):
        assert torch.equal(sample.gaussians.means, expected.means)
        assert torch.equal(sample.gaussians.scales, expected.scales)
    assert "photo.png" in completion.page.view_controls.photo.content
    assert completion.page.view_controls.chosen.options == ("sample 1", "sample 2", "all, side by side")
    assert [sample.finished for sample in seen] == [False, False, True]
    assert said[:2] == ["completesplat: reading photo.png", "completesplat: drawing from photo.png"]
    assert said[-1].startswith("completesplat: 2 drawn in ")
    assert not torch.equal(seen[0].gaussians.means, seen[-1].gaussians.means)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("notes.txt", png(50, 40)[:60], "notes.txt: "),
        ("../../\n\x1betc/passwd", b"nothing", "../../\\n\\x1betc/passwd: not an image"),  # no path, no markup
        ("bomb.png", png(9000, 9000, "1"), "bomb.png: "),  # some kilobytes, 81 million pixels
        ("a.splat", b"nothing", "a.splat: damaged"),
        ("a.PLY", b"nothing", "a.PLY: not a .ply file"),
    ],
)
def test_other_files_are_refused_by_their_own_name(completion, name, content, message):
    browser = Browser()
    before = completion.page.view.samples
    assert load(completion.page, name, content, browser) is before
    assert len(browser.messages) == 1
    assert browser.messages[0].startswith(message)


def test_an_uploaded_scene_is_shown_from_the_front_with_switches_for_its_layers(completion, tmp_path):
    page = completion.page
    scene = balls_sample().gaussians
    page.view.set_up((0.0, 0.0, -1.0))
    write_splat(tmp_path / "a.splat", scene)
    (sample,) = load(page, "some balls.SPLAT", (tmp_path / "a.splat").read_bytes())
    assert torch.equal(sample.gaussians.means, scene.means)
    assert page.view.up.tolist() == [0, -1, 0]
    assert [box.visible for box in page.view_controls.layers] == [True] + [False] * 15
    assert load(completion.page)[0].settings["image"] == "photo.png"
    assert page.view.up.tolist() == completion.model.up.tolist()


def test_an_upload_is_dropped_when_it_is_read_or_refused_and_any_error_is_shown(page, monkeypatch):
    browser = Browser()
    load(page, browser=browser)
    without_weights = "photo.png: not .ply, .splat, .spz, .sog, .ksplat; images need completesplat view IMAGE"
    assert browser.messages == [without_weights]
    assert page.file_controls.upload.value.content == b""
    said = titles(page, monkeypatch)
    monkeypatch.setattr(page, "open", lambda *_: 1 / 0)
    load(page, "a.ply", b"ply", browser)
    assert browser.messages[-1].startswith("ZeroDivisionError: ")
    assert said[-1] == "completesplat"  # no longer that it is reading


def test_one_of_several_scenes_is_chosen(server, tmp_path):
    server.gui.reset()
    for name, count in (("a", 2), ("b", 3)):
        (tmp_path / name).mkdir()
        for i in range(count):
            write_ply(tmp_path / name / f"sample_{i:02}.ply", balls_sample().gaussians)
    view = SplatView(server, (0.0, -1.0, 0.0))
    scenes = {"a": tmp_path / "a", "b": tmp_path / "b"}
    made = Page(server, view, Saver(tmp_path, view, ReferenceRasterizer, 2, 0.5), scenes)
    made.saver.thumbnail = lambda *_: np.zeros((2, 2, 3), np.uint8)
    assert (made.file_controls.chosen.visible, made.file_controls.chosen.options) == (True, ("a", "b"))
    for name, count in (("b", 3), ("a", 2)):
        made.file_controls.chosen.value = name
        assert len(finish(made)) == count
    write_splat(tmp_path / "c.splat", balls_sample().gaussians)
    assert len(load(made, "c.splat", (tmp_path / "c.splat").read_bytes())) == 1
    assert made.file_controls.chosen.value == "loaded: c.splat"
    made.file_controls.chosen.value = "a"
    assert (len(finish(made)), made.file_controls.chosen.options) == (2, ("a", "b"))
    browser = Browser()
    (tmp_path / "a/sample_01.ply").write_text("nothing")
    press(made, made.file_controls.chosen, browser)
    assert "sample_01.ply: not a .ply file" in browser.messages[0]
    made.worker.close()


def test_a_slider_draws_anew_unless_drawing_is_off(completion):
    controls = completion.controls
    controls.live.value = True
    before = load(completion.page)[0].gaussians.means
    controls.skip_weight.value = 0.25
    sample = finish(completion.page)[0]
    assert sample.settings["skip_weight"] == 0.25
    assert not torch.equal(sample.gaussians.means, before)
    controls.steps.value = 3  # moves on to a number that the sampler can make
    assert controls.steps.value == finish(completion.page)[0].settings["steps"] == 2
    before = finish(completion.page)
    controls.live.value = False
    controls.seed.value = 7
    assert finish(completion.page) is before
    assert press(completion.page, controls.draw)[0].settings["seed"] == 7


def test_earlier_samples_can_stay(completion):
    completion.controls.live.value = False
    load(completion.page)
    completion.controls.keep.value = True
    completion.controls.samples.value = 3
    for seed in (1, 2):
        completion.controls.seed.value = seed
        samples = press(completion.page, completion.controls.draw)
    assert [sample.settings["seed"] for sample in samples] == [0, 0, 1, 1, 1, 2, 2, 2]  # eight at most
    samples = press(completion.page, completion.controls.draw)
    assert [sample.settings["seed"] for sample in samples] == [1, 1, 2, 2, 2, 2, 2, 2]


def test_a_refusal_goes_to_its_browser_and_changes_nothing(completion, monkeypatch):
    before = completion.page.view.samples
    browser = Browser()
    other = Browser()
    monkeypatch.setattr(completion.page.server, "get_clients", lambda: {0: browser, 1: other})
    press(completion.page, completion.controls.draw, browser)
    assert load(completion.page, "notes.txt", b"no image", browser) is before
    completion.page.show([])
    press(completion.page, completion.page.save_controls.save, browser)
    for message, start in zip(browser.messages, ("load an", "notes.txt: not an", "there is nothing"), strict=True):
        assert message.startswith(start)
    assert other.messages == []


def drawing(completion: Completion, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Load a photo, and draw it again until the event is set."""
    entered = threading.Event()
    release = threading.Event()
    denoiser = completion.model.denoiser
    forward = denoiser.forward
    load(completion.page)
    monkeypatch.setattr(denoiser, "forward", lambda *a: (entered.set(), release.wait(LIMIT), forward(*a))[-1])
    press(completion.page, completion.controls.draw, wait=False)
    assert entered.wait(LIMIT)
    return release


def test_the_page_answers_while_the_model_works(completion, monkeypatch):
    release = drawing(completion, monkeypatch)
    completion.page.view_controls.layers[0].value = False
    assert not nodes(completion.page)["/sample_0/layer_0"].visible
    assert completion.controls.progress.visible
    release.set()
    finish(completion.page)
    assert not completion.controls.progress.visible


def test_a_fault_is_shown_and_the_page_goes_on(completion, model, monkeypatch, caplog):
    browser = Browser()
    with monkeypatch.context() as broken, caplog.at_level(logging.CRITICAL):
        broken.setattr(completion.page.server, "get_clients", lambda: {0: browser})
        broken.setattr(model, "forward", lambda *_, **__: 1 / 0)
        load(completion.page, browser=browser)
    assert browser.messages == ["ZeroDivisionError: division by zero"]
    assert len(load(completion.page)) == 2


def test_a_drawing_that_fails_half_way_leaves_the_samples_before(completion, model, monkeypatch):
    before = load(completion.page)
    forward = model.denoiser.forward
    steps = []
    shown = []
    monkeypatch.setattr(completion_module, "PAUSE", -1)
    monkeypatch.setattr(model.denoiser, "forward", lambda *a: 1 / 0 if steps else steps.append(1) or forward(*a))
    show = completion.page.show
    monkeypatch.setattr(completion.page, "show", lambda *given: shown.append(given) or show(*given))
    after = press(completion.page, completion.controls.draw)
    assert len(shown) > 1  # estimates, and then the samples again
    assert [id(sample) for sample in after] == [id(sample) for sample in before]


def test_samples_stand_upright_after_a_scene_with_another_direction_up(completion):
    load(completion.page)
    own = completion.page.view.up.tolist()
    completion.page.view.set_up((1.0, 0.0, 0.0))
    press(completion.page, completion.controls.draw)
    assert completion.page.view.up.tolist() == own == completion.model.up.tolist()


def test_an_upload_is_opened_after_the_drawing_that_it_waits_for(completion, monkeypatch, tmp_path):
    release = drawing(completion, monkeypatch)
    write_ply(tmp_path / "a.ply", balls_sample().gaussians)
    upload = completion.page.file_controls.upload
    upload._impl.value = SimpleNamespace(name="a.ply", content=(tmp_path / "a.ply").read_bytes())
    press(completion.page, upload, wait=False)
    release.set()
    assert [sample.gaussians.count for sample in finish(completion.page)] == [600]


FILES = {"ply": ["sample_00.ply", "sample_01.ply"], "sog": ["sample_00.sog", "sample_01.sog"]}
FILES |= {"video": ["orbit_00.mp4", "orbit_01.mp4"], "html": ["page_00.html"]}


@pytest.mark.parametrize("kind", FILES)
def test_files_are_written_and_sent_to_their_browser(page, kind, tmp_path, monkeypatch):
    browser = Browser()
    converter = fake_converter.install(tmp_path / "bin", "splat-transform")
    monkeypatch.setenv("PATH", str(converter.parent), prepend=os.pathsep)
    page.show([balls_sample(), balls_sample()])
    page.view_controls.chosen.value = SIDE_BY_SIDE
    page.save_controls.kind.value = kind
    press(page, page.save_controls.save, browser)
    assert sorted(browser.files) == FILES[kind]
    assert browser.messages == [f"{', '.join(sorted(browser.files))} in {page.saver.folder}"]
    for file, content in browser.files.items():
        assert (page.saver.folder / file).read_bytes() == content


def test_saving_again_overwrites_nothing_and_takes_the_chosen_sample(page):
    page.show([balls_sample(), balls_sample()])
    page.view_controls.chosen.value = "sample 2"
    for _ in range(2):
        press(page, page.save_controls.save)
    page.save_controls.kind.value = "splat"
    press(page, page.save_controls.save)
    files = ["sample_00.ply", "sample_01.ply", "sample_02.splat"]
    assert sorted(path.name for path in page.saver.folder.iterdir()) == files


def test_each_click_saves_what_it_saw_for_its_browser(page):
    release = threading.Event()
    browsers = [Browser(), Browser()]
    page.show([balls_sample(layers=4)])
    page.worker.submit("drawing", lambda: release.wait(LIMIT))
    for browser in browsers:
        press(page, page.save_controls.save, browser, wait=False)
    other = replace(balls_sample(), gaussians=balls_sample().gaussians[:5])
    page.show([other])
    release.set()
    finish(page)
    assert [list(browser.files) for browser in browsers] == [["sample_00.ply"], ["sample_01.ply"]]
    assert [read_ply(path).count for path in sorted(page.saver.folder.iterdir())] == [600, 600]


def test_a_fault_in_saving_goes_to_its_browser(page, monkeypatch, caplog):
    browser = Browser()
    other = Browser()
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: browser, 1: other})
    monkeypatch.setattr(page.saver, "save", lambda *_: 1 / 0)
    with caplog.at_level(logging.CRITICAL):
        press(page, page.save_controls.save, browser)
    assert (browser.messages, other.messages) == (["ZeroDivisionError: division by zero"], [])


@pytest.mark.parametrize("exact", [True, False])
def test_files_have_the_screen_space_dilation_once_and_videos_none(page, monkeypatch, exact):
    """Our rasterizer adds it itself; Gaussians from a file have it already."""
    sample = replace(balls_sample(), exact=exact)
    drawn = []
    drawing = lambda rasterizer, gaussians, *_: drawn.append(gaussians) or (torch.rand(1, 3, 8, 8), None)  # noqa: E731
    monkeypatch.setattr(page_module, "render_views", drawing)
    (ply,), _ = page.saver.save("ply", [sample]), page.saver.save("video", [sample])
    wide = with_screen_space_dilation(sample.gaussians, sample.reference) if exact else sample.gaussians
    assert torch.allclose(read_ply(ply).scales, wide.scales, rtol=1e-5)
    assert torch.equal(read_ply(ply).means, sample.gaussians.means)
    assert torch.equal(drawn[0].scales, sample.gaussians.scales)


def test_a_mesh_is_saved_beside_the_splats(page, monkeypatch):
    corners = torch.cat([torch.zeros(1, 3), torch.eye(3)])
    tetrahedron = Mesh(corners, np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]]), corners, 0.1)
    drawn = []
    monkeypatch.setattr("completesplat.export.formats.mesh_of", lambda *given: drawn.append(given) or tetrahedron)
    paths = [page.saver.save(kind, [balls_sample()])[0] for kind in ("mesh", "mesh", "ply", "mesh")]
    numbered = ["sample_00_mesh.glb", "sample_01_mesh.glb", "sample_00.ply", "sample_02_mesh.glb"]
    assert [path.name for path in paths] == numbered
    assert all(path.is_file() for path in paths)
    assert drawn[0][0] is page.saver.rasterizer()


def test_a_taken_port_leads_to_the_next_one(server):
    second = start_server(server.get_port())
    assert second.get_port() > server.get_port()
    assert second.get_host() == "127.0.0.1"
    second.stop()


def test_names_of_images_are_text_in_the_panels_html_and_tiles_without_a_key_choose_nothing():
    image = np.zeros((2, 2, 3), np.uint8)
    html = comparison(image, None, "<img src=x onerror=alert(1)>")
    assert html.count("<img") == 1
    assert "&lt;img src=x" in html
    tiles = sample_tiles([image] * 11, chosen=1)
    assert (tiles.count("<img"), tiles.count("onclick"), tiles.count("disabled")) == (11, 9, 2)
    assert tiles.count('aria-pressed="true"') == 1


def test_an_empty_page_asks_for_a_photo_and_has_nothing_to_draw_save_or_turn(page, model):
    page.show([])
    made = Completion(page, model, START)
    invitation = page.invitation.window
    assert not invitation.closed
    assert made.controls.draw.disabled
    assert page.save_controls.save.disabled
    assert not page.view_controls.folder.visible
    assert not page.view_controls.motion.visible
    load(page, "notes.txt", b"no image")
    assert not invitation.closed
    load(page)
    assert invitation.closed
    assert not made.controls.draw.disabled
    assert not page.save_controls.save.disabled
    assert page.view_controls.folder.visible
    assert page.view_controls.motion.visible


def test_the_button_of_the_invitation_loads_a_scene_too(page, model, tmp_path):
    page.show([])
    Completion(page, model, START)
    upload = page.invitation.upload
    write_splat(tmp_path / "a.splat", balls_sample().gaussians)
    upload._impl.value = SimpleNamespace(name="a.splat", content=(tmp_path / "a.splat").read_bytes())
    assert len(press(page, upload)) == 1
    assert page.invitation is None


def test_a_page_with_a_scene_does_not_ask_for_a_photo(completion):
    assert completion.page.invitation is None


def test_nothing_is_drawn_when_a_slider_moves_on_a_cpu(completion):
    assert completion.controls.live.value is False
    before = load(completion.page)
    completion.controls.seed.value = 7
    assert finish(completion.page) is before


def opacities(page: Page) -> int:
    return max(int(node.opacities.max()) for node in nodes(page).values())


def test_an_earlier_scene_is_faint_while_a_new_photo_is_drawn_and_clear_again_after_a_failure(
    completion, model, monkeypatch
):
    page = completion.page
    clear = opacities(page)
    seen = []
    forward = type(model).forward
    monkeypatch.setattr(type(model), "forward", lambda *_, **__: (seen.append(opacities(page)), 1 / 0))
    before = page.view.samples
    load(page)
    assert seen[0] < clear / 4
    assert page.view.samples == before
    assert opacities(page) == clear
    monkeypatch.setattr(type(model), "forward", forward)
    load(page)
    assert not page.view.faded


def test_the_photo_stands_beside_the_chosen_sample_from_the_photos_place(completion):
    page = completion.page
    samples = load(page)
    assert "the scene" in page.view_controls.photo.content
    first = page.view_controls.photo.content
    page.view_controls.chosen.value = "sample 2"
    finish(page)
    assert page.view_controls.photo.content != first
    assert page.saver.front(samples[0], 24).shape == (24, 24, 3)
    camera = samples[0].reference
    rendering = ReferenceRasterizer()(samples[0].gaussians[None].to("cpu"), camera[None][None]).over(0.5)
    ours = to_pixels(rendering[0, 0])
    assert abs(page.saver.front(samples[0], len(ours)).astype(float) - ours).mean() < 6


def test_the_object_is_cut_out_on_request(completion, model, monkeypatch):
    seen = []
    read = type(model).read

    def reading(self, file, *given, remove_background=False, crop="whole"):
        seen.append(remove_background)
        return read(self, file, crop=crop)

    monkeypatch.setattr(type(model), "read", reading)
    load(completion.page)
    completion.controls.remove_background.value = True
    load(completion.page)
    assert seen == [False, True]


def choose_crop(completion: Completion, crop: str) -> None:
    """Choose a crop, and wait until its samples are drawn."""
    completion.controls.crop.value = crop
    finish(completion.page)


def take_square(completion: Completion, text: str) -> None:
    completion.controls.square.value = text
    completion.controls.form.submit()
    finish(completion.page)


def taken(completion: Completion) -> tuple[int, int, int, int]:
    """The window of the photo from which the samples on the page were drawn."""
    return completion.photo[1].window


def test_the_middle_or_any_square_of_the_photo_is_drawn_on_request(completion):
    controls = completion.controls
    before = load(completion.page, content=png(80, 40))
    assert taken(completion) == (0, -20, 80, 60)
    choose_crop(completion, "center")
    assert taken(completion) == (20, 0, 60, 40)
    assert "40 x 40 of its 80 x 40 pixels" in completion.page.view_controls.photo.content
    assert completion.page.view.samples is not before
    assert not controls.form.visible
    before = completion.page.view.samples
    choose_crop(completion, "square")  # only shows one
    assert completion.page.view.samples is before
    assert controls.form.visible
    assert controls.square.value == "0, 0, 1"
    take_square(completion, "0.5, 0.25, 0.5")
    assert taken(completion) == (40, 10, 60, 30)
    assert "left:50.00%;top:25.00%;width:25.00%;height:50.00%" in controls.picture.content
    take_square(completion, "0.9, 0, 1")
    assert taken(completion) == (40, 0, 80, 40)
    assert controls.square.value == "0.5, 0, 1"
    choose_crop(completion, "whole")
    assert taken(completion) == (0, -20, 80, 60)
    assert not controls.form.visible


def test_a_square_is_of_one_photo_and_a_middle_of_all(completion):
    load(completion.page, content=png(80, 40))
    choose_crop(completion, "square")
    take_square(completion, "0, 0, 0.5")
    load(completion.page, content=png(40, 80))
    assert taken(completion) == (-20, 0, 60, 80)
    assert completion.controls.crop.value == "whole"
    choose_crop(completion, "center")
    load(completion.page, content=png(80, 40))
    assert taken(completion) == (20, 0, 60, 40)


def test_a_square_that_is_no_square_is_refused_and_changes_nothing(completion, monkeypatch):
    browser = Browser()
    monkeypatch.setattr(completion.page.server, "get_clients", lambda: {0: browser})
    load(completion.page, content=png(80, 40))
    choose_crop(completion, "square")
    before = completion.page.view.samples
    take_square(completion, "face")
    assert "Square: 'face' is not x, y, size" in browser.messages[0]
    assert completion.page.view.samples is before


def test_a_grey_photo_of_sixteen_bits_is_shown_whole():
    content = io.BytesIO()
    Image.fromarray(np.linspace(0, 65535, 60 * 20).reshape(20, 60).astype(np.uint16)).save(content, "PNG")
    whole = PhotoFile("x.png", content.getvalue()).whole(30)
    assert whole.shape == (10, 30, 3)
    assert whole[0, 0, 0] < 30
    assert whole[-1, -1, 2] > 225
    with pytest.raises(CompleteSplatError, match=r"^x\.png: not an image"):
        PhotoFile("x.png", b"nothing").whole(30)
