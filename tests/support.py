"""Helpers that tests of commands share."""

import functools
import gzip
import json
import math
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from omegaconf import DictConfig
from PIL import ExifTags, Image

from completesplat import cli
from completesplat.commands import refusal
from completesplat.commands.jobs import start
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.settings.options import conf_folder, groups

NETWORKS = ["autoreconstructor.encoder.channels=[8,8,16,16]", "denoiser.channels=[32,32,32]"]
SMALL = ["data.image_size=32", "data.batch_size=2", "data.targets=3", "data.evaluation_targets=2", *NETWORKS]
SMALL += ["callbacks.progress=null"]
SMALL += [f"trainer.{s}" for s in ("max_steps=2", "accelerator=cpu", "val_check_interval=2", "limit_val_batches=1")]

GROUPS = {"hydra", *groups()}

only_with_byte_names = pytest.mark.skipif(sys.platform == "darwin", reason="macOS has only names in UTF-8")

LIMIT = 900.0
"""Seconds that a test waits for a state: a busy machine may take minutes for the work of a second."""


@contextmanager
def serving(handler: Callable[..., BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serve with this handler, and return the server's address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=partial(server.serve_forever, poll_interval=0.01), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def waited_for(state: Callable[[], object], seconds: float = LIMIT) -> bool:
    """Wait until a state holds, and return whether it did before the limit."""
    end = time.monotonic() + seconds
    while not state():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["completesplat", *map(str, arguments)])
    monkeypatch.setattr(sys, "path", list(sys.path))  # the working folder is added
    try:
        cli.main()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    return 0


@contextmanager
def interrupted_at(number: int, stage: type) -> Iterator[None]:
    """Training of a stage is interrupted, as by Ctrl-C, at the step of this number."""
    step = stage.training_step

    def training_step(self, *inputs):
        if self.global_step == number:
            raise KeyboardInterrupt
        return step(self, *inputs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "training_step", training_step)
        yield


def script(folder: Path) -> Path:
    """A program as the package's installation puts it on the PATH: for processes, which may start further ones."""
    path = folder / "completesplat"
    path.write_text("from completesplat.cli import main\n\nif __name__ == '__main__':\n    main()\n")
    return path


def python(program: str, *arguments: object, **settings: Any) -> str:
    """Run a program in a new process, which must succeed, and return what it prints."""
    started = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(started, capture_output=True, text=True, **settings)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def write_program(path: Path, text: str) -> Path:
    """Write an executable shell script."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def flip_bit(path: Path, bit: int | None = None) -> None:
    """Flip a bit of a file: of its middle byte, if none is given."""
    content = bytearray(path.read_bytes())
    bit = 8 * (len(content) // 2) if bit is None else bit
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def change_json(path: Path, edit: Callable[[Any], object]) -> None:
    """Change a (gzipped) JSON file: `edit` changes the content in place, or returns another one."""
    packed, raw = path.suffix == ".jgz", path.read_bytes()
    content = json.loads(gzip.decompress(raw) if packed else raw)
    other = edit(content)
    text = json.dumps(content if other is None else other).encode()
    path.write_bytes(gzip.compress(text, 1) if packed else text)


def hub_snapshot(monkeypatch: pytest.MonkeyPatch, hub: Path, name: str) -> Path:
    """Keep to a cache of the Hugging Face hub, and return the folder, not made yet, of a repository's files in it."""
    import huggingface_hub.constants

    repository, commit = hub / f"models--{name.replace('/', '--')}", "0" * 40
    (repository / "refs").mkdir(parents=True)
    (repository / "refs/main").write_text(commit)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(hub))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    return repository / "snapshots" / commit


def shipped_folders(root: Path, **known: tuple[int, Sequence[float] | None]) -> dict[str, Path]:
    """Folders with descriptions of weights: the size and the mean colour of their training images, None if unknown."""
    for name, (size, mean) in known.items():
        (root / name).mkdir(parents=True)
        training = {} if mean is None else {"picture_mean": [*map(float, mean), *[0.0] * 5], "picture_std": [0.1] * 8}
        (root / name / "config.json").write_text(json.dumps({"image_size": size, "training": training}))
    return {name: root / name for name in known}


def strict_json(path: Path):
    """Parse JSON, refusing the NaN and Infinity that Python's reader lets through."""

    def refuse(name: str):
        raise ValueError(f"{path} holds {name}")

    return json.loads(path.read_text(), parse_constant=refuse)


@functools.cache
def _composed_once(verb: str, *choices: str) -> bytes:
    """Return a pickled config, of which a copy takes a twentieth of `copy.deepcopy`'s time."""
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return pickle.dumps(compose(verb, overrides=list(choices)))


def compose_config(verb: str, *overrides: str) -> DictConfig:
    """Return the config of a verb, as the command line would compose it; a choice of options is composed only once."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    keys = [entry.key_or_group for entry in parsed]
    chosen = [key.partition("/")[0] in GROUPS or key.startswith("hydra.") for key in keys]
    choices = [text for text, choice in zip(overrides, chosen, strict=True) if choice]
    config = pickle.loads(_composed_once(verb, *choices))
    values = [entry for entry, choice in zip(parsed, chosen, strict=True) if not choice]
    ConfigLoaderImpl._apply_overrides_to_config(values, config)
    return config


def refused(verb: str, *overrides: object) -> str:
    """Return the line with which a verb refuses its settings, without the command; empty for another exception."""
    with pytest.raises(Exception) as caught:  # noqa: PT011
        start(verb, compose_config(verb, *map(str, overrides)), Path("/nowhere"))
    return refusal(caught.value) or ""


def write_capture(folder: Path, frames: int, names: Sequence[str] = ()) -> None:
    """Write `transforms.json` and images from a circle around the origin, looking at it; the first have these names."""
    folder.mkdir(exist_ok=True)
    listed = []
    for number in range(frames):
        angle = 2 * math.pi * number / frames
        back, right = np.array([math.sin(angle), 0, math.cos(angle)]), np.array([math.cos(angle), 0, -math.sin(angle)])
        pose = np.eye(4)  # OpenGL's axes: the camera looks along -z
        pose[:3] = np.stack([right, [0, 1, 0], back, 3 * back], axis=1)
        name = names[number] if number < len(names) else f"frame{number}.png"
        Image.new("RGB", (16, 12), (30 * number,) * 3).save(folder / name)
        listed.append({"file_path": name, "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": listed}))


def exif_turned(orientation: int) -> Image.Exif:
    """A record that says how an image is to be turned."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    return exif


def tiny_generator() -> CompleteSplat:
    """An untrained generator from the configs, with skips that pass something on."""
    settings = ["model.autoreconstructor_checkpoint=null", "data.image_size=32", "sampler.steps=2"]
    config = compose_config("fit", "model=latent_diffusion", *settings)
    torch.manual_seed(0)
    model = instantiate(config.model.completesplat, _convert_="all")
    for skip in model.autoreconstructor.reconstructor.skips.values():
        torch.nn.init.normal_(skip.weight, std=0.1)
    return model.eval()


def round_gaussians(means: torch.Tensor, scale: float, opacity: float, colors: object) -> Gaussians:
    """Gaussians of one size and opacity at these means; a colour for each, or one for all."""
    shape, turns = means.shape[:-1], torch.tensor([1.0, 0, 0, 0])
    scales, opacities = torch.full((*shape, 3), scale), torch.full(shape, opacity)
    colors = torch.as_tensor(colors).float().expand(*shape, 3)
    return Gaussians(means, turns.expand(*shape, 4), scales, opacities, colors)


def some_gaussians(batch: int, scale: float = 0.1, opacity: float = 0.5) -> Gaussians:
    """Two equal Gaussians in each set of a batch."""
    return round_gaussians(torch.zeros(batch, 2, 3), scale, opacity, torch.zeros(batch, 2, 3))
