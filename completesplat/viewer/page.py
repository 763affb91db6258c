"""The viewer's page: its controls, its worker thread, and the files that it saves."""

import logging
import tempfile
import threading
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
import viser

from completesplat.errors import CompleteSplatError
from completesplat.export.formats import FORMATS, suffix, write_format
from completesplat.export.images import to_pixels
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.splat_transform import PageView
from completesplat.export.subject import all_around, subject_of
from completesplat.export.video import render_views, write_video
from completesplat.files import write_text
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.trajectories import orbit
from completesplat.quantities import SPLATS
from completesplat.rasterizers import Rasterizer
from completesplat.viewer import panel
from completesplat.viewer.access import GuardedServer, show_status, stop_server, with_head
from completesplat.viewer.sample import Sample, read_scene, read_stored_photo
from completesplat.viewer.splat_view import SplatView
from completesplat.viewer.turning import Turntable
from completesplat.wording import printable

Task = Callable[[], None]

THUMBNAIL = 160  # px
COMPARED = 384  # px, of the photo in the panel
MOST_THUMBNAILS = 24
SHOWN = "shown"  # kind of all jobs that show other samples

log = logging.getLogger(__name__)


class Worker:
    """A thread that does one job after another, so that the page answers meanwhile.

    Only the newest waiting job of each kind is done, because a moving slider submits more jobs than can be computed.
    `failed` is called with every exception that a job raises, and the thread goes on.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._jobs = dict[Hashable, Future[None]]()
        self._pool = ThreadPoolExecutor(1, "completesplat-viewer")
        self._lock = threading.Lock()
        self.closed = False

    def submit(self, kind: Hashable, job: Task) -> None:
        """Add a job after the waiting ones, and drop a waiting one of the same kind."""
        with self._lock:
            if kind in self._jobs:
                self._jobs[kind].cancel()  # without effect if it has begun
            if not self.closed:
                self._jobs[kind] = self._pool.submit(self._do, job)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until no job is left, and return whether none is left.

        Args:
            timeout: longest time to wait for a job, in seconds.
        """
        while True:
            unfinished = [job for job in list(self._jobs.values()) if not job.done()]
            if not unfinished:
                return True
            if futures.wait(unfinished, timeout).not_done:
                return False

    def close(self) -> None:
        """Drop the waiting jobs, and wait for the current one: torch aborts a process that ends while it computes."""
        with self._lock:
            self.closed = True
        self._pool.shutdown(cancel_futures=True)

    def _do(self, job: Task) -> None:
        try:
            job()
        except Exception as error:
            try:
                self._failed(error)
            except Exception:
                log.exception("the viewer could not show an error")


class Saver:
    """Writer of numbered files in a folder, which overwrites nothing.

    `make_rasterizer` is called for the first rendering. Videos have `frames` frames and a grey background.
    """

    def __init__(
        self, folder: Path, view: SplatView, make_rasterizer: Callable[[], Rasterizer], frames: int, background: float
    ) -> None:
        self.folder = folder
        self.view = view
        self.frames = frames
        self.background = background
        self.rasterizer = cache(make_rasterizer)

    def save(self, kind: str, samples: Sequence[Sample]) -> list[Path]:
        """Write samples in a format, as videos, or the page (`html`).

        Raises:
            CompleteSplatError: there are no samples.
        """
        if not samples:
            raise CompleteSplatError("there is nothing to save yet: draw samples first")
        self.folder.mkdir(parents=True, exist_ok=True)
        if kind == "html":
            return [write_viewer_page(self.view.server, self._next("page", ".html"))]
        if kind == panel.VIDEO:
            return [self._video(sample) for sample in samples]
        return [self._scene(kind, sample) for sample in samples]

    def thumbnail(self, sample: Sample, size: int) -> panel.Pixels:
        """Render a sample from behind, where samples differ, with `size` px on the longer side."""
        up = torch.from_numpy(self.view.up).to(sample.reference.intrinsics)
        return self._rendered(sample, orbit(sample.reference, sample.pivot(), up, 2)[1], size)

    def front(self, sample: Sample, size: int) -> panel.Pixels:
        """Render a sample from the photo's place, with `size` px on the longer side."""
        return self._rendered(sample, sample.reference, size)

    def _rendered(self, sample: Sample, camera: Cameras, size: int) -> panel.Pixels:
        scene = sample.for_viewers()
        factor = size / max(camera.image_size)
        height = max(1, round(camera.image_size[0] * factor))
        width = max(1, round(camera.image_size[1] * factor))
        intrinsics = camera.intrinsics * camera.intrinsics.new_tensor([[factor], [factor], [1.0]])
        small = Cameras(camera.world_to_camera, intrinsics, (height, width))
        views, _ = render_views(self.rasterizer(), scene, small[None], self.background)
        return to_pixels(views[0].nan_to_num())

    def _scene(self, kind: str, sample: Sample) -> Path:
        """Write all layers of a sample."""
        path = self._next("sample", suffix(kind))
        comments = [f"{name} {value}" for name, value in sample.settings.items()]
        front = PageView(sample.reference, sample.pivot(), torch.tensor(self.view.up), self.background)
        rasterizer = self.rasterizer() if kind == "mesh" else None
        name = path.name.removesuffix(suffix(kind))
        write_format(self.folder, name, kind, sample.for_viewers(), front, comments, rasterizer)
        return path

    def _video(self, sample: Sample) -> Path:
        path = self._next("orbit", ".mp4")
        up = sample.reference.intrinsics.new_tensor(self.view.up.tolist())
        subject = subject_of(PlacedScene(sample.gaussians, sample.reference, up), self.rasterizer())
        cameras = orbit(all_around(sample.reference, subject), subject.center, up, self.frames)
        frames, _ = render_views(self.rasterizer(), sample.gaussians, cameras, self.background)
        write_video(path, frames)
        return path

    def _next(self, stem: str, suffix: str) -> Path:
        taken = {path.name.partition(".")[0] for path in self.folder.glob(f"{stem}_*")}
        number = 0
        while f"{stem}_{number:02}{suffix}".partition(".")[0] in taken:
            number += 1
        return self.folder / f"{stem}_{number:02}{suffix}"


class Page:
    """Controls and scene of one server. Its worker does the slow work.

    `scenes` are files and folders to choose from, by name. `complete` is called with an uploaded image and its name.
    """

    def __init__(self, server: GuardedServer, view: SplatView, saver: Saver, scenes: Mapping[str, Path]) -> None:
        self.server = server
        self.view = view
        self.saver = saver
        self.scenes = scenes
        self.complete: Callable[[Path, str, viser.ClientHandle | None], None] | None = None
        self.last_error: Exception | None = None
        self.worker = Worker(self.tell)
        self.file_controls = panel.add_file_controls(server.gui, [*scenes])
        self.file_controls.upload.on_upload(self._upload)
        self.file_controls.chosen.on_update(self._choose)
        self.turntable = Turntable(server, view)
        self.view_controls = panel.add_view_controls(server.gui)
        self._connect_view_controls()
        self.save_controls = panel.add_save_controls(server.gui, FORMATS)
        self.save_controls.save.on_click(self._save)
        self._thumbnails: list[panel.Pixels] = []
        self._photo: tuple[panel.Pixels, str] | None = None
        self.invitation: SimpleNamespace | None = None
        self.show(view.samples)

    def show(self, samples: Sequence[Sample], status: str = "") -> None:
        """Show samples in all browsers, and their thumbnails when all of them are finished."""
        self.view.show(samples)
        numbers = range(1, max(1, len(samples)) + 1)
        options = (*(f"sample {number}" for number in numbers), panel.SIDE_BY_SIDE)
        if self.view_controls.chosen.options != options:
            self.view_controls.chosen.options = options
        layers = max((sample.layers for sample in samples), default=0)
        for i, box in enumerate(self.view_controls.layers):
            box.visible = i < layers
        self.save_controls.save.disabled = not samples
        self.view_controls.folder.visible = bool(samples)
        self.view_controls.motion.visible = bool(samples)
        if samples:
            self.withdraw_invitation()
        show_status(self.server, status)
        if all(sample.finished for sample in samples):
            self.worker.submit("comparison", self._draw_comparison)
            self.worker.submit("thumbnails", partial(self._draw_thumbnails, samples))

    def invite(self) -> None:
        """Ask for a photo if nothing is shown."""
        if not self.view.samples:
            self.invitation = panel.add_invitation(self.server.gui)
            self.invitation.upload.on_upload(self._upload)

    def withdraw_invitation(self) -> None:
        if self.invitation is not None:
            self.invitation.window.close()
            self.invitation = None

    def open(self, path: Path, name: str) -> None:
        """Show what `read_scene` reads instead of the samples, from the front."""
        show_status(self.server, f"reading {name}")
        samples, up = read_scene(path)
        self.view.set_up(up)
        self.show(samples, name)
        self.show_photo(path)

    def show_photo(self, scene: Path) -> None:
        """Show a prediction's photo, if its folder has one, in the panel."""
        self.set_photo(None)  # also if the next is damaged
        self.set_photo(read_stored_photo(scene, COMPARED), "photo")

    def set_photo(self, photo: panel.Pixels | None, label: str = "") -> None:
        """Show a photo in the panel (None: none), and beside it what is on the page, when that is finished."""
        self._photo = None if photo is None else (photo, label)
        self.view_controls.photo.content = "" if photo is None else panel.comparison(photo, None, label)
        self.worker.submit("comparison", self._draw_comparison)

    def _draw_comparison(self) -> None:
        """Render the first of the samples on the page from the photo's place, in the worker's thread."""
        photo = self._photo
        samples = self.view.visible
        if photo is None or not samples or self.view.faded or not samples[0].finished:
            return
        scene = self.saver.front(samples[0], max(photo[0].shape[:2]))
        if self._photo is photo:
            self.view_controls.photo.content = panel.comparison(photo[0], scene, photo[1])

    def _choose(self, event: viser.GuiEvent[Any]) -> None:
        name = self.file_controls.chosen.value
        if name in self.scenes:
            self.file_controls.chosen.options = tuple(self.scenes)
            self.submit(SHOWN, event.client, partial(self.open, self.scenes[name], name))

    def _upload(self, event: viser.GuiEvent[Any]) -> None:
        """Show an uploaded scene, or complete an uploaded image, when the scene that is being drawn is finished."""
        file = event.target.value
        name = printable(file.name)
        content = file.content
        file.content = b""  # which the button would keep until the next upload
        self.submit(SHOWN, event.client, partial(self._open_upload, event.client, name, content))

    def _open_upload(self, client: viser.ClientHandle | None, name: str, content: bytes) -> None:
        """Open an uploaded file, whose name is never used as a path."""
        suffix = Path(name).suffix.lower()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"upload{suffix if suffix in SPLATS else ''}"
            path.write_bytes(content)
            try:
                if suffix in SPLATS:
                    self.open(path, name)
                    self._let_choose_another(name)
                elif self.complete is None:
                    raise CompleteSplatError(f"{name}: not {', '.join(SPLATS)}; images need completesplat view IMAGE")
                else:
                    self.complete(path, name, client)
            except CompleteSplatError as error:
                raise CompleteSplatError(str(error).replace(str(path), name)) from error

    def _let_choose_another(self, name: str) -> None:
        """Name an uploaded scene in the choice, so that each of `scenes` can be chosen next."""
        chosen = self.file_controls.chosen
        uploaded = f"loaded: {name}"
        chosen.options = (uploaded, *self.scenes)
        chosen.visible = bool(self.scenes)
        chosen.value = uploaded

    def _draw_thumbnails(self, samples: Sequence[Sample]) -> None:
        """Render thumbnails, in the worker's thread, unless there is a single sample."""
        first = samples[:MOST_THUMBNAILS] if len(samples) > 1 else []
        self._thumbnails = [self.saver.thumbnail(sample, THUMBNAIL) for sample in first]
        self._mark_thumbnail()

    def _mark_thumbnail(self) -> None:
        row = panel.sample_tiles(self._thumbnails, self.view.chosen) if self._thumbnails else ""
        if self.view_controls.tiles.content != row:
            self.view_controls.tiles.content = row

    def submit(self, kind: Hashable, client: viser.ClientHandle | None, job: Task) -> None:
        """Let the worker do a job (`Worker.submit`) whose errors go to one browser (None: to all)."""

        def job_with_errors_told() -> None:
            try:
                job()
            except Exception as error:
                self.tell(error, client)

        self.worker.submit(kind, job_with_errors_told)

    def tell(self, error: Exception, client: viser.ClientHandle | None = None) -> None:
        """Show an error in one browser or in all, and keep it. A fault of the program is logged as well."""
        show_status(self.server, "")  # what was waited for
        self.last_error = error
        text = str(error)
        if not isinstance(error, CompleteSplatError):
            text = f"{type(error).__name__}: {text}"
            log.error("the viewer goes on after %s", text, exc_info=error)
        browsers = list(self.server.get_clients().values()) if client is None else [client]
        for browser in browsers:
            browser.add_notification("Not possible", text, color="red")

    def close(self) -> None:
        self.worker.close()
        stop_server(self.server)

    def _connect_view_controls(self) -> None:
        controls = self.view_controls
        view = self.view

        def changed(_: viser.GuiEvent[Any]) -> None:
            index = controls.chosen.options.index(controls.chosen.value)
            last = len(controls.chosen.options) - 1
            view.chosen = None if index == last else index
            view.hidden_layers = {i for i, layer in enumerate(controls.layers) if not layer.value}
            view.depth = controls.depth.value
            view.cameras = {name for name, box in controls.cameras.items() if box.value}
            view.refresh()
            self._mark_thumbnail()
            self.worker.submit("comparison", self._draw_comparison)

        def moved(event: viser.GuiEvent[Any]) -> None:
            if controls.motion.value == panel.TURN:
                self.turntable.start(event.client_id, time.monotonic())
                return
            self.turntable.stop(event.client_id)
            if controls.motion.value == panel.FROM_THE_FRONT:
                view.look_from_the_front(event.client)

        def pressed(index: int, _: viser.CommandEvent) -> None:
            if index < len(controls.chosen.options) - 1:  # key 0, which is -1, chooses all
                controls.chosen.value = controls.chosen.options[index]

        for digit, command in controls.keys.items():
            command.on_trigger(partial(pressed, int(digit) - 1))
        controls.chosen.on_update(changed)
        for box in (*controls.layers, controls.depth, *controls.cameras.values()):
            box.on_update(changed)
        controls.motion.on_click(moved)
        controls.turn.on_trigger(lambda event: self.turntable.start(event.client_id, time.monotonic()))
        controls.stop.on_trigger(lambda event: self.turntable.stop(event.client_id))

    def _save(self, event: viser.GuiEvent[Any]) -> None:
        client = event.client
        kind = self.save_controls.kind.value
        samples = list(self.view.visible)
        if client is None:
            return

        def save() -> None:
            show_status(self.server, f"saving {kind}")
            files = self.saver.save(kind, samples)
            show_status(self.server, "")
            for file in files:
                client.send_file_download(file.name, file.read_bytes())
            names = ", ".join(file.name for file in files)
            client.add_notification("Saved", f"{names} in {self.saver.folder}")

        self.submit(object(), client, save)  # each click counts


def write_viewer_page(server: viser.ViserServer, path: Path) -> Path:
    """Write the server's scene, without controls, as one HTML file that needs no server."""
    write_text(path, with_head(server.get_scene_serializer().as_html()))
    return path
