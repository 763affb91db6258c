"""Several pictures at once, file formats, videos, and what is said about them."""

import re
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import pytest
import torch
from fake_converter import calls, install
from PIL import Image
from support import compose_config, some_gaussians, strict_json

from completesplat.commands.predict import find_pictures, folder_names, run, unusual_field_of_view
from completesplat.data.pictures.photograph import Photograph
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians, concatenate
from completesplat.generation import CompleteSplat

QUICK = ["samples=1", "frames=2", "steps=1", "video=[]", "rasterizer=reference"]


def draw(model: CompleteSplat, photograph: Photograph, visible: object, **settings: object) -> list[Gaussians]:
    """In place of the networks, which other tests run: a few splats in the photograph's colour."""
    scene = concatenate([some_gaussians(1)[0]] * 10)
    place = torch.linspace(-0.5, 0.5, 20)
    means = torch.stack([place, place.sin(), place + 3], dim=-1)
    return [replace(scene, means=means, colors=photograph.image.mean((1, 2)).expand(20, 3).contiguous())]


@pytest.fixture
def predict(command, tiny_weights, tmp_path, monkeypatch):
    monkeypatch.setattr(CompleteSplat, "forward", draw)

    def start(image: object, *settings: str):
        given = [f"image={image}", f"weights={tiny_weights}", f"out={tmp_path / 'out'}", *QUICK]
        return command("predict", *given, *settings)

    return start


def picture(path: Path, color: str = "red") -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.new("RGB", (40, 32), color).save(path)
    return path


def test_a_folder_is_its_pictures_sorted_and_not_those_of_its_folders(tmp_path):
    for name in ("b.jpg", "a.PNG"):
        picture(tmp_path / "photos" / name)
    (tmp_path / "photos/c.png").mkdir()
    (tmp_path / "photos/notes.txt").write_text("no picture")
    folder, single = tmp_path / "photos", tmp_path / "x.raw"
    assert find_pictures(str(folder)) == [folder / "a.PNG", folder / "b.jpg"]
    assert find_pictures([str(single), str(folder)]) == [single, folder / "a.PNG", folder / "b.jpg"]
    with pytest.raises(CompleteSplatError, match="no picture in this folder"):
        find_pictures(str(folder / "c.png"))
    with pytest.raises(CompleteSplatError, match="at least one"):
        find_pictures([])


def test_pictures_of_one_name_get_folders_of_their_own():
    names = ["x/a.jpg", "y/a.jpg", "a_2.png", "A.png", "b.jpg", "c.tar.gz"]
    assert folder_names([Path(name) for name in names]) == ["a", "a_2", "a_2_2", "A_3", "b", "c.tar"]


def test_a_picture_that_fails_is_named_and_does_not_stop_the_others(predict, tmp_path):
    picture(tmp_path / "x/a.png")
    (tmp_path / "x/b.jpg").write_text("no picture")
    finished = predict(f"[{tmp_path / 'x'},nowhere.png,{picture(tmp_path / 'y/a.png', 'blue')}]")
    assert finished.status == 2
    broken, missing, summary = finished.err.splitlines()
    assert re.match("error: .*b.jpg", broken)
    assert "nowhere.png: no such file" in missing
    assert summary == f"error: 2 of 4 pictures failed (b.jpg, nowhere.png); the others are in {tmp_path / 'out'}"
    done = [line.partition(":")[0] for line in finished.out.splitlines() if "/4 " in line]
    assert done == ["1/4 a.png", "4/4 a.png"]
    found = [(path.parent.name, path.name) for path in (tmp_path / "out").glob("*/*")]
    assert sorted(found) == [(a, name) for a in ("a", "a_2") for name in ("sample_00.ply", "scene.json", "sheet.png")]
    assert (tmp_path / "out/a/sample_00.ply").read_bytes() != (tmp_path / "out/a_2/sample_00.ply").read_bytes()


def test_if_all_fail_nothing_is_said_to_be_left(predict, tmp_path):
    assert predict("[x.png,y.png]").err.splitlines()[-1] == "error: 2 of 2 pictures failed (x.png, y.png)"
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 truncated")
    finished = predict(tmp_path / "broken.jpg")
    assert (finished.status, finished.err.count("\n")) == (2, 1)
    assert re.match("error: .*broken.jpg", finished.err)
    assert not (tmp_path / "out/broken").exists()


def test_videos_and_formats_are_written_and_recorded_and_a_strange_field_of_view_told(predict, tmp_path, monkeypatch):
    program = install(tmp_path / "bin", "splat-transform")
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    wanted = ["formats=[splat,sog,html]", "video=[swipe,wobble]", "frames=3", "fov=15"]
    finished = predict(picture(tmp_path / "a.png"), *wanted)
    assert finished.status == 0
    assert "a.png: the field of view is 15 degrees (given), 50 in training" in finished.out
    folder = tmp_path / "out/a"
    written = {path.name for path in folder.iterdir()}
    videos = {"swipe_00.mp4", "wobble_00.mp4"}
    assert written == videos | {"sample_00.splat", "sample_00.sog", "sample_00.html", "sheet.png", "scene.json"}
    assert all(len(imageio.mimread(folder / name, memtest=False)) == 3 for name in videos)
    files = strict_json(folder / "scene.json")["files"]
    assert written - {"scene.json"} == set(files.values())
    assert (files["swipe_00"], files["wobble_00"]) == ("swipe_00.mp4", "wobble_00.mp4")
    assert len(calls(program)) == 3  # its version, before the model runs


def test_a_converter_that_is_missing_is_told_before_the_model_is_loaded(predict, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(CompleteSplat, "from_pretrained", lambda *_: pytest.fail("loaded"))
    finished = predict(picture(tmp_path / "a.png"), "formats=html")
    assert finished.status == 2
    assert finished.err.startswith("error: formats spz, sog and html need Node.js")


def test_wishes_without_a_meaning_are_refused_before_the_model_is_loaded(tmp_path):
    for setting, said in (
        ("formats=[ply,obj]", "formats=obj: choose from ply, splat, spz, sog, html"),
        ("video=zoom", "video=zoom: choose from orbit, swipe, wobble"),
        ("mask=x.png", "mask=FILE belongs to one picture"),
    ):
        config = compose_config("predict", "image=[a.png,b.png]", "weights=nowhere", setting)
        with pytest.raises(CompleteSplatError, match=re.escape(said)):
            run(config, tmp_path)


@pytest.mark.parametrize("broken", ["some", "all"])
def test_gaussians_that_are_not_finite_reach_no_file(predict, tmp_path, monkeypatch, broken):
    def damaged(*args, **settings):
        (scene,) = draw(*args, **settings)
        scene.opacities[: 7 if broken == "some" else None] = torch.nan
        return [scene]

    monkeypatch.setattr(CompleteSplat, "forward", damaged)
    finished = predict(picture(tmp_path / "a.png"), "formats=[ply,splat]")
    if broken == "all":
        assert (finished.status, (tmp_path / "out/a").exists()) == (2, False)
        assert "a.png: sample 0: all 20 Gaussians are broken" in finished.err
        return
    assert finished.status == 0
    assert finished.out.count("left out 7 of 20 Gaussians") == 1
    assert strict_json(tmp_path / "out/a/scene.json")["settings"]["gaussians"] == [13]
    assert (tmp_path / "out/a/sample_00.splat").stat().st_size == 13 * 32


@pytest.mark.parametrize(
    ("own", "trained", "said"),
    [
        (69.0, 50.0, None),  # tan 34.5 / tan 25 = 1.47
        (90.0, 2 * 26.565051, "about 2.0 times too flat"),  # tan 45 = 2 tan 26.57
        (2 * 26.565051, 90.0, "about 2.0 times too deep"),
        (20.0, 50.0, "the field of view is 20 degrees (from EXIF; fov=DEGREES overrides it), 50 in training"),
    ],
)
def test_a_field_of_view_far_from_trainings_is_told_with_what_it_does(own, trained, said):
    warning = unusual_field_of_view(Photograph(torch.zeros(3, 8, 8), own, "exif"), trained)
    assert (warning is None) if said is None else (said in warning)
