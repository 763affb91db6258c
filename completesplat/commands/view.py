"""`completesplat view`: a page in the browser that shows scenes and samples new ones."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from completesplat.commands.locks import is_running
from completesplat.errors import CompleteSplatError, needing
from completesplat.quantities import SPLATS
from completesplat.settings.checks import REMOVE, check_parts
from completesplat.weights import AUTO, CONFIG_FILE, NEWEST, RUN_CHECKPOINT, SCENES, WEIGHTS_FILE, shipped
from completesplat.wording import printable

WEIGHT_FILES = (CONFIG_FILE, WEIGHTS_FILE)
WEIGHT_SUFFIXES = (".ckpt", ".pth", ".safetensors")
PAUSE = 2.0  # seconds between two checks for new scenes of a run
FRAME = 1 / 30  # seconds between two images of a scene that turns
SCENE_FILES = ("sample_*.ply", "scene.ply")
AT_STEP = "step {} of the training"


def run(config: DictConfig, out: Path) -> None:
    """Open the page, fill it and stay until Ctrl-C, or write it to a file with `export`.

    The page first says that it is loading, because importing torch takes a second and loading the model longer. The
    address of a page with the user's own files is printed when they are read, because they may be refused.
    """
    with needing("view", "the viewer needs viser"):
        import viser  # noqa: F401

    from completesplat.viewer.access import start_server, stop_server

    if config.path is not None:
        config.update(setting_of_path(Path(config.path)))
    check_asked(config)
    own_weights = config.weights not in (AUTO, *shipped())
    own_files = config.image is not None or config.scene is not None or own_weights
    server = start_server(0 if config.export is not None else config.port)
    address = f"{server.address} (Ctrl-C ends it)"
    page = None
    try:
        if config.export is None and not own_files:
            print(address, flush=True)
        page = make_page(server, config, out)
        if config.export is not None:
            return export(page, Path(config.export))
        if own_files:
            print(address, flush=True)
        stay(page, None if config.watch is None else Path(config.watch))
    finally:
        stop_server(server) if page is None else page.close()


def stay(page: Any, run: Path | None) -> None:
    """Turn the page's scene, and show what a run (None: none) writes, until Ctrl-C."""
    step = None
    checked = time.monotonic()
    while True:
        time.sleep(FRAME)
        now = time.monotonic()
        page.turntable.step(now)
        if run is not None and now - checked > PAUSE:
            step = show_newest(page, run, step)
            checked = now


def check_asked(config: DictConfig) -> None:
    """Raise CompleteSplatError if the page's file has another suffix, or a scene is given with what makes new ones."""
    if config.export is not None and Path(config.export).suffix.lower() != ".html":
        raise CompleteSplatError(f"export={config.export}: a page is written, so give a name such as export=page.html")
    shown = config.watch if config.scene is None else config.scene
    if shown is not None and (config.image is not None or config.weights != AUTO):
        raise CompleteSplatError(f"{shown}: is shown as it is; image= and weights= are for new scenes")


def setting_of_path(path: Path) -> dict[str, str]:
    """Return the setting (`scene`, `image`, `weights`, `watch`) for a path, or raise CompleteSplatError."""
    if path.is_file():
        return {setting_of_file(path): str(path)}
    if not path.is_dir():
        raise CompleteSplatError(f"{path}: no such file or folder")
    if (path / NEWEST).parent.is_dir() and is_running(path):
        return {"watch": str(path)}
    for folder in (path, path / "weights"):
        if all((folder / name).is_file() for name in WEIGHT_FILES):
            return {"weights": str(folder)}
    fitted = (path / "scene.ply").is_file()  # a run's result
    if (path / RUN_CHECKPOINT).is_file() and not fitted:
        return {"weights": str(path)}
    if scenes_in(path):
        return {"scene": str(path)}
    names = ", ".join((*WEIGHT_FILES, *SPLATS))
    raise CompleteSplatError(f"{path}: neither weights nor scenes in it or in weights/ ({names})")


def setting_of_file(path: Path) -> str:
    """Return the setting for a file, by its suffix."""
    suffix = path.suffix.lower()
    if suffix in SPLATS:
        return "scene"
    return "weights" if suffix in WEIGHT_SUFFIXES else "image"


def scenes_in(path: Path) -> dict[str, Path]:
    """Return a scene itself (a file, a prediction, a fitted scene), or those in a folder and its `scenes/`, by name."""
    if path.is_file() or holds_scene(path):
        return {path.name: path}
    folders = [folder for folder in (path, path / SCENES) if folder.is_dir()]
    entries = [entry for folder in folders for entry in sorted(folder.iterdir())]
    scenes = [entry for entry in entries if entry.suffix.lower() in SPLATS or holds_scene(entry)]
    return {printable(scene.relative_to(path).as_posix()): scene for scene in scenes}


def holds_scene(folder: Path) -> bool:
    """Return whether a folder has the files of a prediction or of a fitted scene."""
    return any(any(folder.glob(name)) for name in SCENE_FILES)


def make_page(server: Any, config: DictConfig, out: Path) -> Any:
    """Create a server's page and fill it with the scenes or the model that the settings name."""
    check_parts(config)
    if config.watch is not None:
        note, samples, up = newest_scenes(Path(config.watch))
        page = empty_page(server, config, out, up)
        page.show(samples, note)
        return page
    if config.scene is not None:
        return page_of_scenes(server, config, out)
    return page_of_model(server, config, out)


def page_of_scenes(server: Any, config: DictConfig, out: Path) -> Any:
    """Create a page that shows the first of the scenes in a file or folder, and lets others be chosen."""
    from completesplat.viewer.sample import read_scene

    scenes = scenes_in(Path(config.scene)) or {"": Path(config.scene)}  # which `read_scene` refuses
    name, path = next(iter(scenes.items()))
    samples, up = read_scene(path)
    page = empty_page(server, config, out, up, scenes=scenes)
    page.show(samples, name)
    page.show_photo(path)
    return page


def page_of_model(server: Any, config: DictConfig, out: Path) -> Any:
    """Create a page that draws scenes from photos, the first of which the settings may name."""
    from completesplat.commands.trained import open_generator
    from completesplat.viewer.completion import Completion
    from completesplat.viewer.panel import SLIDERS
    from completesplat.viewer.photo_file import PhotoFile

    image = None if config.image is None else Path(config.image)
    remove = config.background == REMOVE
    model = open_generator(config, [] if image is None else [image])
    photograph = None if image is None else model.read(image, config.fov, remove, crop=config.crop)
    page = empty_page(server, config, out, model.up.tolist(), model)
    start = {name: config[name] for name in SLIDERS}
    start["remove_background"] = remove
    start["crop"] = config.crop if isinstance(config.crop, str) else "whole"
    completion = Completion(page, model, start)
    if image is not None and photograph is not None:
        file = PhotoFile(printable(image.name), image.read_bytes(), config.fov, remove)
        completion.open(file, photograph, config.crop)
    return page


def empty_page(
    server: Any,
    config: DictConfig,
    out: Path,
    up: Sequence[float],
    model: Any = None,
    scenes: Mapping[str, Path] | None = None,
) -> Any:
    """Create a page without samples.

    Args:
        up: the direction up.
        model: the model that draws scenes on the page, if one does.
        scenes: scenes to choose from, by name.
    """
    from hydra.utils import instantiate

    from completesplat.commands.trained import shown_background
    from completesplat.viewer.access import show_background
    from completesplat.viewer.page import Page, Saver
    from completesplat.viewer.splat_view import SplatView

    background = shown_background(config.background, model)
    show_background(server, background)
    view = SplatView(server, up)
    make_rasterizer = partial(instantiate, config.rasterizer, _convert_="all")
    return Page(server, view, Saver(out, view, make_rasterizer, config.frames, background), scenes or {})


def newest_scenes(run: Path) -> tuple[str, Sequence[Any], Sequence[float]]:
    """Wait for a run's fixed scenes, and return a note on their step, the scenes and the direction up.

    Raises:
        CompleteSplatError: the run draws no fixed scenes.
    """
    from completesplat.viewer.sample import NEWEST_FILE, read_newest

    folder = run / NEWEST
    if not folder.parent.is_dir():
        raise CompleteSplatError(f"watch={run}: no {folder.parent.name}/ here, which fit fills (callbacks.images)")
    if not (folder / NEWEST_FILE).is_file():
        print(f"{run}: no scenes yet; waiting for them (every callbacks.images.every_n_steps steps)", flush=True)
    while not (folder / NEWEST_FILE).is_file():
        time.sleep(PAUSE)
    step, samples, up = read_newest(folder)
    return AT_STEP.format(step), samples, up


def show_newest(page: Any, run: Path, newest: int | None) -> int | None:
    """Show what the run has written after step `newest`, and return its newest step. None: after the page was made."""
    from completesplat.viewer.sample import read_newest

    try:
        step, samples, _ = read_newest(run / NEWEST)
    except CompleteSplatError:
        return newest  # the scenes are just being written, or were removed: the page stays as it is
    if samples and step not in {newest, *(sample.settings.get("step") for sample in page.view.samples)}:
        page.show(samples, AT_STEP.format(step))
    return step


def export(page: Any, path: Path) -> None:
    """Write the page to a file when its work is done, or raise CompleteSplatError if it shows no scene."""
    from completesplat.viewer.page import write_viewer_page

    page.worker.wait()
    if not page.view.samples:
        raise page.last_error or CompleteSplatError("there is nothing to export: give a scene, or an image and weights")
    print(write_viewer_page(page.server, path))
