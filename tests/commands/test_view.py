import re
import sys

import pytest
from support import compose_config
from viewer_scenes import balls

from completesplat.commands.settings import View
from completesplat.commands.view import data_cameras, settings_of
from completesplat.errors import CompleteSplatError
from completesplat.export.ply import write_ply
from completesplat.schema import check_settings


def folder(path, *names: str):
    path.mkdir()
    for name in names:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_bytes(b"")
    return path


def test_what_a_path_stands_for(tmp_path):
    weights = folder(tmp_path / "w", "config.json", "model.safetensors")
    run = folder(tmp_path / "run", "weights/config.json", "weights/model.safetensors", "run.json")
    prediction = folder(tmp_path / "p", "sample_00.ply", "scene.json")
    outer = folder(tmp_path / "o", "photo/sample_00.ply", "run.json")
    files = folder(tmp_path / "f", "A.PLY", "photo.jpg")
    assert settings_of(weights) == {"weights": str(weights)}
    assert settings_of(run) == {"weights": str(run / "weights")}
    assert settings_of(prediction) == {"scene": str(prediction)}
    assert settings_of(outer) == {"scene": str(outer / "photo")}
    assert settings_of(files / "A.PLY") == {"scene": str(files / "A.PLY")}
    assert settings_of(files / "photo.jpg") == {"image": str(files / "photo.jpg")}


def test_what_cannot_be_shown_is_refused(tmp_path):
    folder(tmp_path / "several", "a/sample_00.ply", "b/sample_00.ply")
    for path, said in (
        ("nowhere.ply", "nowhere.ply: no such file or folder"),
        (".", "neither weights (config.json, model.safetensors, here or in weights/) nor a prediction"),
        ("several", "2 predictions: give one of them"),
    ):
        with pytest.raises(CompleteSplatError, match=re.escape(said)):
            settings_of(tmp_path / path)


def test_settings_out_of_their_ranges_are_refused():
    for setting, said in (("samples=9", "between 1 and 8"), ("port=99999", "between 1 and 65535")):
        with pytest.raises(CompleteSplatError, match=f"{setting}: must lie {said}"):
            check_settings(View, compose_config("view", setting))


def test_without_viser_the_way_to_get_it_is_said(command, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    finished = command("view", f"out={tmp_path}")
    assert finished.status == 2
    assert finished.err == 'error: the viewer needs viser: pip install "completesplat[view]"\n'


def test_an_offline_page_is_written_from_a_scene_and_of_what_is_drawn(command, pipeline, tmp_path):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    out = f"out={tmp_path / 'out'}"
    write_ply(tmp_path / "my scene.ply", balls(points=5))
    finished = command("view", "my scene.ply", "--export", "page.html", out)
    assert finished.status == 0, finished.err
    text = (tmp_path / "page.html").read_text()
    assert text.startswith("<!doctype html>")
    assert "__VISER_EMBED_DATA__" in text
    drawn = [pipeline.photograph(), f"weights={pipeline.weights}", "samples=2", "steps=2", "export=drawn.html"]
    assert command("view", *drawn, out).status == 0
    assert (tmp_path / "drawn.html").is_file()
    finished = command("view", pipeline.weights, "export=other.html", out)
    assert finished.status == 2
    assert "there is nothing to export" in finished.err
    assert not (tmp_path / "other.html").exists()


def test_cameras_of_a_data_set_are_read(toy_root):
    given = ["data=toy_objects", f"data.root={toy_root}", "data.image_size=32"]
    cameras = data_cameras(compose_config("view", *given).data)
    assert cameras.world_to_camera.shape == (4, 4, 4)  # four frames
    assert cameras.centers[0].tolist() == pytest.approx([0, 0, 0], abs=1e-6)
    assert (cameras.centers[1:].norm(dim=-1) > 0.1).all()
