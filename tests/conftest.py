"""Fixtures that several folders of tests use."""

import gc
import os
import pickle
import shutil
import signal
import subprocess
import sys
import venv
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from filelock import FileLock

ROOT = Path(__file__).parents[1]

# W&B would go on reading what later tests of the process print, and complain in their logs that its run has ended.
os.environ.setdefault("WANDB_CONSOLE", "off")

Folders = Callable[[str, Callable[[Path], object]], Path]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep the garbage collector from searching all imported objects, now and later: a third of the collection's time.

    For the same reason this file imports what is heavy inside its fixtures. While tests run, garbage is searched for
    less often than by default, because commands import hundreds of modules, and a search visits all their objects.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000, 50, 100)
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def quick_compositions() -> Iterator[None]:
    """Parse each config file once in a process, and compose a command's config once.

    Hydra composes it a second time to learn `hydra.mode`, which no file of `conf/` sets. Both take half of the time.
    """
    from hydra._internal.hydra import Hydra
    from hydra.core.plugins import Plugins
    from hydra.plugins.config_source import ConfigSource

    results, get_mode = {}, Hydra.get_mode

    def mode(self: Hydra, config_name: str | None, overrides: list[str]) -> object:
        return get_mode(self, config_name, overrides) if any("hydra" in text for text in overrides) else None

    def read_once(read: Callable[[ConfigSource, str], object]) -> Callable[[ConfigSource, str], object]:
        def load_config(source: ConfigSource, config_path: str) -> object:
            path = Path(source.path, source._normalize_file_name(config_path))
            state = path.stat() if path.is_file() else None  # None: Hydra's own files, which do not change
            key = source.provider, source.path, config_path, state and (state.st_ino, state.st_size, state.st_mtime_ns)
            if key not in results:
                results[key] = pickle.dumps(read(source, config_path))
            return pickle.loads(results[key])

        return load_config

    with pytest.MonkeyPatch.context() as monkeypatch:
        for kind in Plugins.instance().discover(ConfigSource):  # importing its module would make the class anew
            monkeypatch.setattr(kind, "load_config", read_once(kind.load_config))
        monkeypatch.setattr(Hydra, "get_mode", mode)
        yield


@pytest.fixture(scope="session")
def built_once(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Folders that all processes of a test run share: the first one that needs a folder fills it, the others wait.

    A folder that could not be filled is filled anew by whoever needs it next.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    # A worker's folder lies in that of the test run.
    base = tmp_path_factory.getbasetemp().parent if worker else tmp_path_factory.getbasetemp()

    def build(name: str, fill: Callable[[Path], object]) -> Path:
        folder, complete = base / f"shared_{name}", base / f"shared_{name}.complete"
        with FileLock(base / f"shared_{name}.lock"):
            if not complete.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                complete.touch()
        return folder

    return build


def made(out: Path, *arguments: str) -> None:
    """Run the command, which must succeed, from the folder of its output."""
    from support import call

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(out.parent)
        assert call(monkeypatch, *arguments, f"out={out}") == 0


@pytest.fixture(scope="session")
def toy_root(built_once: Folders) -> Path:
    """Root of a CO3D tree with the category `toy_objects`: 4 sequences (2 train, 1 val, 1 test), 4 frames, 32 px."""
    from completesplat.data.toy import write_objects

    size = {"scenes": 4, "frames": 4, "size": 32, "seed": 0}
    return built_once("toy", lambda root: write_objects(root, **size, workers=1, progress=False))


class Pipeline(NamedTuple):
    """Run folders of both stages, trained for two steps, and their data."""

    toy: Path
    var: Path
    diffusion: Path

    @property
    def weights(self) -> Path:
        return self.diffusion / "weights"

    def photograph(self) -> Path:
        return sorted(self.toy.glob("*/*/images/*.jpg"))[0]


@pytest.fixture(scope="session")
def pipeline(toy_root: Path, built_once: Folders) -> Pipeline:
    from support import SMALL

    def train(runs: Path) -> None:
        fit = ["fit", f"data.root={toy_root}", *SMALL]
        stage1 = runs / "var/checkpoints/last.ckpt"
        stage2 = ["experiment=toy_diffusion", f"model.autoreconstructor_checkpoint={stage1}", "sampler.steps=2"]
        made(runs / "var", *fit, "experiment=toy_var")
        made(runs / "diffusion", *fit, *stage2)

    runs = built_once("runs", train)
    return Pipeline(toy_root, runs / "var", runs / "diffusion")


@pytest.fixture(scope="session")
def packed_toys(pipeline: Pipeline, built_once: Folders) -> Path:
    """The pipeline's scenes, packed."""
    given = ["data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "workers=1"]
    return built_once("packed", lambda folder: made(folder / "store", "data", "prepare", *given)) / "store"


@pytest.fixture(scope="session")
def latent_cache(pipeline: Pipeline, packed_toys: Path, built_once: Folders) -> Path:
    """The training set, encoded by the pipeline's stage 1."""
    given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']"]
    return built_once("latents", lambda folder: made(folder / "cache", "data", "latents", *given)) / "cache"


@pytest.fixture(scope="session")
def tiny_weights(built_once: Folders) -> Path:
    """Weights of an untrained model for images of 32 x 32 pixels."""
    from support import tiny_generator

    return built_once("weights", lambda folder: tiny_generator().save_pretrained(folder))


class Installed(NamedTuple):
    """The wheel, and an environment that has it and borrows this environment's packages."""

    wheel: Path
    environment: Path

    def run(self, folder: Path, *arguments: str | Path) -> str:
        """Run a program of the environment in a folder, check that it succeeds, and return what it prints."""
        outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        command = [self.environment / "bin" / arguments[0], *arguments[1:]]
        done = subprocess.run(command, cwd=folder, env=outside, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout


@pytest.fixture(scope="session")
def installed(built_once: Folders) -> Installed:
    """Build the wheel and install it in a new environment; only hatchling is downloaded."""

    def install(folder: Path) -> None:
        building = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT]
        subprocess.run(building, check=True)
        venv.create(folder / "env", with_pip=True)
        packages = next((folder / "env").glob("lib/python*/site-packages"))
        (packages / "parent.pth").write_text("".join(f"{path}\n" for path in sys.path if path.endswith("-packages")))
        # Forced, because this package may be installed here as well.
        installing = ["-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", *folder.glob("*.whl")]
        subprocess.run([folder / "env/bin/python", *installing], check=True)

    folder = built_once("installed", install)
    return Installed(next(folder.glob("*.whl")), folder / "env")


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Sets torch's number of threads, until the test ends."""
    import torch

    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def plain_signals():
    """The system's signal handlers, as in a new process; trainers of other tests may have left Lightning's."""
    from completesplat.signals import ENDING

    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Finished(NamedTuple):
    """Exit status and output of a command."""

    status: int
    out: str
    err: str


class Command(NamedTuple):
    """`completesplat`, run in this process."""

    run: Callable[..., Finished]

    def __call__(self, *arguments: object) -> Finished:
        return self.run(*arguments)

    def succeeds(self, *arguments: object) -> Finished:
        finished = self.run(*arguments)
        assert finished.status == 0, finished.err
        return finished

    def refuses(self, *arguments: object) -> str:
        """Check that a command is refused in one line with status 2, and return the line without `error: `."""
        finished = self.run(*arguments)
        assert (finished.status, finished.err.count("\n"), finished.err[:7]) == (2, 1, "error: "), finished.err
        return finished.err[7:-1]


@pytest.fixture
def command(capfd, monkeypatch, tmp_path) -> Command:
    """The command, run from an empty folder."""
    from support import call

    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> Finished:
        capfd.readouterr()
        status = call(monkeypatch, *arguments)
        return Finished(status, *capfd.readouterr())

    return Command(run)


@pytest.fixture
def rembg(monkeypatch):
    """rembg's interface as it is used (2.0.86): it turns images by their EXIF; here red is the background."""
    import numpy as np
    from PIL import Image, ImageOps

    from completesplat.photo import background

    module = ModuleType("rembg")
    module.sessions = []

    def remove(image, session=None):
        turned = ImageOps.exif_transpose(image).convert("RGBA")
        pixels = np.array(turned)
        pixels[..., 3] = np.where(pixels[..., 0] > 128, 0, 255)
        return Image.fromarray(pixels)

    module.new_session, module.remove = lambda name: module.sessions.append(name), remove
    monkeypatch.setitem(sys.modules, "rembg", module)
    background._session.cache_clear()
    yield module
    background._session.cache_clear()
