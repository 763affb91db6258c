import os
import re
import subprocess
import sys
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, build_opener

import pytest
import torch
from PIL import Image
from scenes_for_training import scene_batch
from support import LIMIT
from viewer_scenes import balls
from written_commands import ROOT

from completesplat.commands.locks import hold_job_lock
from completesplat.commands.view import newest_scenes, scenes_in, setting_of_path, show_newest
from completesplat.errors import CompleteSplatError
from completesplat.export.description import UP
from completesplat.export.ply import write_ply
from completesplat.installation import install_command
from completesplat.training.fixed_scenes import write_newest
from completesplat.viewer.sample import Sample


def folder(path, *names: str):
    path.mkdir()
    for name in names:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(b"")
    return path


PATHS = [
    ("checkpoints/last.ckpt config.yaml scene.ply", "", "scene"),
    ("config.json model.safetensors", "", "weights"),
    ("weights/config.json weights/model.safetensors run.json", "", "weights of the run"),
    ("sample_00.ply scene.json", "", "scene"),
    ("photo/sample_00.ply run.json", "", "scene"),
    ("A.PLY photo.jpg", "A.PLY", "scene"),
    ("A.PLY photo.jpg", "", "scene"),
    ("A.PLY photo.jpg", "photo.jpg", "image"),
    ("config.json model.safetensors", "model.safetensors", "weights"),
]


def test_what_a_path_stands_for(tmp_path):
    for number, (written, given, setting) in enumerate(PATHS):
        path = folder(tmp_path / str(number), *written.split()) / given
        shown = path / "weights" if setting == "weights of the run" else path
        assert setting_of_path(path) == {setting.partition(" ")[0]: str(shown)}


def test_the_scenes_of_a_folder_can_be_chosen(tmp_path):
    written = "b/sample_00.ply a/scene.ply scenes/c/scene.ply A.PLY b.splat c.jpg"
    several = folder(tmp_path / "s", *written.split())
    names = ["A.PLY", "a", "b", "b.splat", "scenes/c"]
    assert scenes_in(several) == {name: several / name for name in names}
    assert scenes_in(several / "b") == {"b": several / "b"}  # whose files are samples of one scene
    assert scenes_in(several / "b.splat") == {"b.splat": several / "b.splat"}
    assert scenes_in(tmp_path / "nowhere") == {}


def test_what_cannot_be_shown_is_refused(tmp_path):
    known = "(config.json, model.safetensors, .ply, .splat, .spz, .sog, .ksplat)"
    for path, message in (
        ("nowhere.ply", "nowhere.ply: no such file or folder"),
        (".", f"neither weights nor scenes in it or in weights/ {known}"),
    ):
        with pytest.raises(CompleteSplatError, match=re.escape(message)):
            setting_of_path(tmp_path / path)


def test_weights_that_are_not_there_are_refused_before_the_page_opens(command):
    finished = command("view", "weights=nowhere")
    assert (finished.status, finished.out) == (2, "")
    assert finished.err.startswith("error: nowhere: no such folder")


@pytest.mark.parametrize("beside", ["image=a.png", "weights=toy_objects"])
def test_a_scene_is_not_shown_in_the_place_of_a_photo_or_weights_that_are_given_too(command, tmp_path, beside):
    (tmp_path / "g.ply").touch()
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    assert (
        command.refuses("view", "g.ply", beside) == "g.ply: is shown as it is; image= and weights= are for new scenes"
    )


def run_in_training(path, step: int = 2):
    """A run's folder as far as it is watched."""
    newest = path / "images/newest"
    newest.mkdir(parents=True, exist_ok=True)
    scenes = scene_batch(batch=2)
    gaussians = balls(points=5)
    write_newest(newest, step, gaussians.map(lambda values: torch.stack([values] * 2)), scenes, torch.tensor(UP))
    return path


def test_a_run_is_watched_while_a_process_is_at_work_in_it(tmp_path):
    run = run_in_training(folder(tmp_path / "run", "checkpoints/last.ckpt", "config.yaml"))
    assert setting_of_path(run) == {"weights": str(run)}
    (run / ".lock").touch()
    assert setting_of_path(run) == {"weights": str(run)}
    with hold_job_lock(run, run):
        assert setting_of_path(run) == {"watch": str(run)}
        assert (run / ".lock").read_text().split()[0] == str(os.getpid())  # as it was


def test_a_run_of_another_user_whose_lock_may_not_be_opened_is_not_watched(tmp_path, monkeypatch):
    run = run_in_training(folder(tmp_path / "run", ".lock", "config.json", "model.safetensors"))
    monkeypatch.setattr("filelock.FileLock.acquire", Mock(side_effect=PermissionError))
    assert setting_of_path(run) == {"weights": str(run)}
    assert setting_of_path(run) == {"weights": str(run)}


def test_what_a_run_writes_is_shown_when_it_is_new(tmp_path, capsys):
    run, shown = run_in_training(tmp_path / "run"), []
    view = SimpleNamespace(samples=newest_scenes(run)[1])
    page = SimpleNamespace(view=view, show=lambda *given: (shown.append(given[1]), setattr(view, "samples", given[0])))
    last = show_newest(page, run, None)
    assert (last, shown) == (2, [])
    for step in (4, 4, 6):
        run_in_training(run, step)
        last = show_newest(page, run, last)
    assert shown == ["step 4 of the training", "step 6 of the training"]
    view.samples = [Sample(balls(points=5), 1, view.samples[0].reference)]  # a file that somebody loads meanwhile
    assert show_newest(page, run, last) == 6
    (run / "images/newest/scenes.json").write_text("{")
    assert show_newest(page, run, last) == 6
    assert len(shown) == 2
    with pytest.raises(CompleteSplatError, match=r"no images/ here, which fit fills"):
        newest_scenes(tmp_path)


def test_a_run_without_scenes_is_waited_for(tmp_path, capsys, monkeypatch):
    (tmp_path / "run/images").mkdir(parents=True)
    monkeypatch.setattr("completesplat.commands.view.time.sleep", lambda _: run_in_training(tmp_path / "run"))
    _, samples, up = newest_scenes(tmp_path / "run")
    assert (len(samples), up) == (2, UP)
    assert "no scenes yet; waiting" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["photo.jpg", "scene.ply"])
def test_a_file_that_cannot_be_read_is_refused_before_the_address_is_printed(name, command, monkeypatch, tmp_path):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    monkeypatch.setattr("completesplat.commands.view.time", None)  # a page that opens would stay until it is ended
    (tmp_path / name).write_text("neither")
    finished = command("view", tmp_path / name, f"out={tmp_path / 'out'}")
    assert (finished.status, name in finished.err) == (2, True)
    assert "http" not in finished.out


def test_without_viser_the_way_to_get_it_is_said(command, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    refused = command.refuses("view", f"out={tmp_path}")
    assert refused == f"the viewer needs viser: {install_command('view')}"


@pytest.mark.processes
def test_the_page_is_there_before_torch_and_says_that_it_is_loading(tmp_path):
    """The page runs in a new process, in which importing torch never ends."""
    viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from viser.infra import _infra
    from websockets.sync.client import connect

    (tmp_path / "torch.py").write_text("print('torch', flush=True)\ninput()\n")
    program = [sys.executable, "-m", "completesplat", "view", f"out={tmp_path / 'out'}"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(program, env=environment, text=True, **pipes) as process:
        try:
            address = process.stdout.readline().split(" ")[0]
            assert address.startswith("http:")
            assert process.stdout.readline() == "torch\n"
            assert build_opener(ProxyHandler({})).open(address, timeout=LIMIT).status == 200
            place, protocol = urlsplit(address), f"viser-v{viser.__version__}"
            given = {"origin": f"http://{place.netloc}", "subprotocols": [protocol], "proxy": None}
            with connect(address.replace("http:", "ws:"), **given) as socket:
                page = socket.recv(timeout=LIMIT)  # behind its size, before and after compression
            content = _infra.zstandard.ZstdDecompressor().decompressobj().decompress(page[16:])
            assert b"completesplat: loading the model or scene" in content
        finally:
            process.kill()


def test_an_offline_page_is_written_from_a_scene_and_of_what_is_drawn(command, pipeline, tmp_path):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    out = f"out={tmp_path / 'out'}"
    write_ply(tmp_path / "my scene.ply", balls(points=5))
    command.succeeds("view", "my scene.ply", "export=page.html", out)
    text = (tmp_path / "page.html").read_text()
    assert text.startswith("<!doctype html>")
    assert "__VISER_EMBED_DATA__" in text
    drawn = [pipeline.photograph(), f"weights={pipeline.weights}", "samples=2", "steps=2", "export=drawn.html"]
    command.succeeds("view", *drawn, out)
    assert (tmp_path / "drawn.html").is_file()
    refused = command("view", pipeline.weights, "export=other.html", out)
    assert (refused.status, "there is nothing to export" in refused.err) == (2, True)
    assert not (tmp_path / "other.html").exists()


@pytest.mark.parametrize("name", ["photo.png", "scene.ply", "page", ""])
def test_a_page_is_not_written_over_a_file_that_is_none(command, tmp_path, name):
    (tmp_path / "scene.ply").touch()
    refused = command.refuses("view", "scene.ply", f"export={name}")
    assert refused == f"export={name}: a page is written, so give a name such as export=page.html"
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["scene.ply"]
