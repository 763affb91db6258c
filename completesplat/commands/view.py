"""`completesplat view`: a page on which to look at scenes and to draw new ones."""

import time
from functools import partial
from pathlib import Path
from signal import SIGINT
from typing import Any

from completesplat.errors import CompleteSplatError, DataError
from completesplat.names import printable
from completesplat.signals import Interrupted
from completesplat.weights import CONFIG_FILE, RUN_CHECKPOINT, SCENES, WEIGHTS_FILE

WEIGHT_FILES = (CONFIG_FILE, WEIGHTS_FILE)
KINDS = {".ply": "scene", ".ckpt": "weights", ".pth": "weights"}
MOST_CAMERAS = 24
SCENE_FILES = ("sample_*.ply", "scene.ply")


def run(config: Any, out: Path) -> None:
    """Open the page and stay until Ctrl-C; with `export`, write it as a file instead."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise CompleteSplatError('the viewer needs viser: pip install "completesplat[view]"') from error

    config.update(settings_of(Path(config.path)) if config.path is not None else {})
    page = make_page(config, out)
    try:
        if config.export is not None:
            return export(page, Path(config.export))
        print(f"{page.server.address} (Ctrl-C ends it)", flush=True)
        while True:
            time.sleep(3600)
    except Interrupted as stop:
        if stop.signal != SIGINT:
            raise
    finally:
        page.close()


def settings_of(path: Path) -> dict[str, str]:
    """The setting that a path stands for: `scene`, `image` or `weights`; `CompleteSplatError` for none of these."""
    if path.is_file():
        return {KINDS.get(path.suffix.lower(), "image"): str(path)}
    if not path.is_dir():
        raise CompleteSplatError(f"{path}: no such file or folder")
    for folder in (path, path / "weights"):
        if all((folder / name).is_file() for name in WEIGHT_FILES):
            return {"weights": str(folder)}
    if (path / RUN_CHECKPOINT).is_file():
        return {"weights": str(path)}
    inner = [*path.iterdir(), *((path / SCENES).iterdir() if (path / SCENES).is_dir() else [])]
    folders = [folder for folder in (path, *sorted(inner)) if any(any(folder.glob(name)) for name in SCENE_FILES)]
    if len(folders) == 1 or path in folders:
        return {"scene": str(folders[0])}
    if folders:
        raise CompleteSplatError(f"{path} holds {len(folders)} predictions: give one of them, {folders[0]} for example")
    raise CompleteSplatError(
        f"{path}: neither weights ({', '.join(WEIGHT_FILES)}, here or in weights/) nor a prediction (sample_*.ply)"
    )


def make_page(config: Any, out: Path) -> Any:
    """The page with what the settings name, on a port of its own."""
    import torch
    from hydra.utils import instantiate

    from completesplat.commands.trained import open_generator
    from completesplat.viewer.completion import Completion
    from completesplat.viewer.page import Page, Saver, start_server, stop_server
    from completesplat.viewer.panel import SLIDERS
    from completesplat.viewer.sample import read_scene
    from completesplat.viewer.stage import Stage

    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = open_generator(config).to(device) if config.scene is None else None
    samples, up = ([], tuple(model.up.tolist())) if model is not None else read_scene(Path(config.scene))
    photograph = None if model is None or config.image is None else model.read(Path(config.image), config.fov)
    cameras = None if config.get("data") is None else data_cameras(config.data)
    server = start_server(0 if config.export is not None else config.port, config.background)
    try:
        stage = Stage(server, up, cameras)
        stage.show(samples)
        rasterizer = partial(instantiate, config.rasterizer, _convert_="all")
        saver = Saver(out, stage, rasterizer, config.frames, config.background)
        if model is None:
            return Page(server, stage, saver, max(sample.layers for sample in samples))
        page = Page(server, stage, saver, model.parameterization.layers)
        own_steps = model.sampler.steps if model.draws_samples else 1
        steps = own_steps if config.steps is None else config.steps
        completion = Completion(page, model, {name: config[name] for name in SLIDERS} | {"steps": steps})
        if photograph is not None:
            completion.load(printable(Path(config.image).name), photograph)
        return page
    except BaseException:
        stop_server(server)
        raise


def data_cameras(config: Any) -> Any:
    """Cameras of the first training sequence that can be read, in the frame of its first one: at most 24, evenly.

    `DataError`: no sequence can be read.
    """
    import torch
    from hydra.utils import instantiate

    data = instantiate(config, _convert_="all")
    data.prepare_data()
    source = data.source("train")
    for name in source.names:
        try:
            cameras = source.read(name).cameras.to(dtype=torch.float32)
        except DataError:
            continue
        count = len(cameras.world_to_camera)
        return cameras.relative_to(cameras[0])[:: -(-count // MOST_CAMERAS)]
    raise DataError("no training sequence can be read", str(config.root))


def export(page: Any, path: Path) -> None:
    """Write what the page shows when its work is done; `CompleteSplatError` if it shows nothing."""
    from completesplat.viewer.page import write_page

    page.worker.wait()
    if not page.stage.samples:
        raise CompleteSplatError("there is nothing to export: give a scene, or a picture and weights")
    print(write_page(page.server, path))
