"""Predictions of several images at once, file formats, videos, warnings and refusals."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import pytest
import torch
from fake_converter import calls, install
from PIL import Image
from rich.progress import Progress
from support import compose_config, only_with_byte_names, some_gaussians, strict_json

from completesplat.commands import trained
from completesplat.commands.inputs import find_images
from completesplat.commands.predict import object_mask, output_files, run
from completesplat.errors import CompleteSplatError
from completesplat.export.formats import FORMATS
from completesplat.export.reading import read_gaussians
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.generator import CompleteSplat
from completesplat.installation import install_command
from completesplat.photo.reading import Framing, Photograph, read_square

QUICK = ["samples=1", "frames=2", "steps=1", "video=[]", "rasterizer=reference"]


def draw(model: CompleteSplat, photograph: Photograph, **settings: object) -> list[Gaussians]:
    """In place of the networks, which other tests run: a few splats in the photograph's colour."""
    scene = merge_gaussians([some_gaussians(1)[0]] * 10)
    place = torch.linspace(-0.5, 0.5, 20)
    means = torch.stack([place, place.sin(), place + 3], dim=-1)
    return [replace(scene, means=means, colors=photograph.image.mean((1, 2)).expand(20, 3).contiguous())]


@pytest.fixture
def predict(command, tiny_weights, tmp_path, monkeypatch):
    monkeypatch.setattr(CompleteSplat, "forward", draw)

    def start(image: object, *settings: str):
        given = [f"image={image}", f"weights={tiny_weights}", f"out={tmp_path / 'out'}", *QUICK]
        return command("predict", *given, *settings)

    return command._replace(run=start)


def save(path: Path, color: str = "red") -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.new("RGB", (40, 32), color).save(path)
    return path


def test_a_folder_is_its_images_sorted(tmp_path):
    for name in ("b.jpg", "a.PNG"):
        save(tmp_path / "photos" / name)
    folder, single = tmp_path / "photos", tmp_path / "x.raw"
    (folder / "c.png").mkdir()
    (folder / "link.png").symlink_to("nowhere")
    (folder / "same.png").symlink_to("a.PNG")
    (folder / "notes.txt").write_text("no image")
    images = [folder / name for name in ("a.PNG", "b.jpg", "same.png")]
    (folder / "._a.png").touch()  # as in archives of macOS
    assert find_images(str(folder)) == images
    assert find_images([str(single), str(folder)]) == [single, *images]
    assert find_images(f"{folder}/*") == find_images(f"{tmp_path}/**/[ab]*.*") + images[2:] == images
    (folder / "[a].png").symlink_to("a.PNG")
    assert find_images(f"{folder}/[a].png") == [folder / "[a].png"]  # a file's own name is no pattern
    no_list = "give an image, a folder, or a list of them"
    refusals = [([], "at least one"), *((odd, no_list) for odd in (None, "", ["a.png", None], {"a": 1}))]
    refusals += [("nofile.jpg", r"^nofile\.jpg: no such file"), ("a" * 5000, "^a{200,500}: no such file$")]
    refusals += [(f"{folder}/*.gif", r"gif: no image fits: \.jpg, ")]
    refusals += [
        (f"{folder}/c.png", rf"no image in this folder \(for those below it: image='{folder}/c.png/\*\*'\): \.jpg")
    ]
    for given, message in refusals:
        with pytest.raises(CompleteSplatError, match=message):
            find_images(given)


def test_a_folders_photos_may_have_any_suffix_of_jpeg(predict, tmp_path):
    names = ["a.jpe", "b.jfif", "c.JPG", "d.JFIF"]
    for name in names:
        save(tmp_path / "photos" / name)
    finished = predict(tmp_path / "photos")
    assert finished.status == 0, finished.err
    scenes = sorted((tmp_path / "out").glob("*/scene.json"))
    assert [strict_json(scene)["settings"]["image"] for scene in scenes] == names


ODD_NAMES = [b"...png", b"\xff.png", b"[red].png", b"new\nline.png", b"a" * 250 + b".png", b"\x1b[31m.png", b"a\\b.png"]


@only_with_byte_names
def test_images_of_any_name_are_written_below_out(predict, tmp_path, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # which rich takes for a terminal
    content = save(tmp_path / "x.png").read_bytes()
    (tmp_path / "photos").mkdir()
    for name in ODD_NAMES:
        (tmp_path / "photos" / os.fsdecode(name)).write_bytes(content)
    finished = predict(tmp_path / "photos", "fov=15")  # with a warning for each
    assert (finished.status, finished.err) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == {"x.png", "photos", "out"}
    folders = [path for path in (tmp_path / "out").iterdir() if path.is_dir()]
    assert len(folders) == len(ODD_NAMES)
    recorded = {strict_json(folder / "scene.json")["settings"]["image"] for folder in folders}
    assert {"...png", "\\udcff.png", "new\\nline.png"} < recorded
    assert "\x1b[31m" not in finished.out


@pytest.mark.parametrize("terminal", ["0", "1"])
def test_each_scene_file_and_video_is_announced_in_a_line_or_on_a_terminals_bar(
    predict, tmp_path, monkeypatch, terminal
):
    monkeypatch.setenv("TTY_COMPATIBLE", terminal)
    monkeypatch.setattr(Progress, "update", lambda bar, task, **new: steps.append((bar.disable, new)))
    steps: list[tuple[bool, dict[str, object]]] = []
    for name in ("a.png", "[b].png"):
        save(tmp_path / "x" / name)
    finished = predict(tmp_path / "x", "formats=[ply,splat]", "video=[orbit,swipe]")
    files = ["drawing 1 sample", "sample_00.ply", "sample_00.splat", "orbit_00.mp4", "swipe_00.mp4"]
    begun = [f"{name}: {file}" for name in ("[b].png", "a.png") for file in files]
    shown = [str(new["description"]).replace("\\[", "[") for _, new in steps if "description" in new]
    lines = [line for line in finished.out.splitlines() if line in begun]
    assert (shown, lines) == (begun, [] if terminal == "1" else begun)
    assert sum(int(new.get("advance", 0)) for _, new in steps) == 2 * 4
    assert [new["completed"] for _, new in steps if "completed" in new] == [5, 10]


@only_with_byte_names
@pytest.mark.processes
def test_names_that_are_no_utf_8_are_printed_by_a_process_that_prints_utf_8(tmp_path, tiny_weights):
    """A new process is needed, because pytest's own streams print any name."""
    name, out = os.fsdecode(b"\xff.png"), os.fsdecode(b"out\xff")
    (tmp_path / name).write_bytes(save(tmp_path / "x.png").read_bytes())
    program = "from completesplat.cli import main; main()"
    given = [f"image='{name}'", f"weights={tiny_weights}", f"out='{out}'", *QUICK]  # as hydra wants them
    environment = os.environ | {"PYTHONUTF8": "0", "PYTHONIOENCODING": "utf-8:strict"}
    started = [sys.executable, "-c", program, "predict", *given]
    done = subprocess.run(started, cwd=tmp_path, env=environment, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"/out\\udcff\n" in done.stdout
    assert (tmp_path / out / "_" / "sheet.png").is_file()


def test_images_that_fail_are_named_and_do_not_stop_the_others(predict, tmp_path, monkeypatch):
    """One cannot be read, one is not there, and one lets the program fail."""

    def faulty(model, photograph, **settings):
        if photograph.image[1].mean() > 0.4:
            raise ValueError("a fault\nof the program")
        return draw(model, photograph, **settings)

    monkeypatch.setattr(CompleteSplat, "forward", faulty)
    save(tmp_path / "x/a.png")
    for other in ("noext", "notes.txt", ".hidden"):
        (tmp_path / "x" / other).write_text("no photo")
    (tmp_path / "x/b.jpg").write_bytes(b"\xff\xd8\xff\xe0 truncated")
    lime, blue = save(tmp_path / "lime.png", "lime"), save(tmp_path / "y/a.png", "blue")
    finished = predict(f"[{tmp_path / 'x'},nowhere.png,{lime},{blue}]")
    assert finished.status == 2
    assert "left out: 2 other files: noext, notes.txt" in finished.out
    broken, missing, fault, summary = finished.err.splitlines()
    assert re.match("error: .*b.jpg", broken)
    assert "nowhere.png: no such file" in missing
    assert fault == f"error: {lime}: a fault of the program"
    assert "Traceback" in finished.out
    failed = "3 of 5 images failed (b.jpg, nowhere.png, lime.png)"
    assert summary == f"error: {failed}; the others are in {tmp_path / 'out'}"
    done = [line.partition(":")[0] for line in finished.out.splitlines() if "/5 " in line]
    assert done == ["1/5 a.png", "5/5 a.png"]
    result = [(path.parent.name, path.name) for path in (tmp_path / "out").glob("*/*")]
    assert sorted(result) == [
        (a, name) for a in ("a", "a_2") for name in ("photo.png", "sample_00.ply", "scene.json", "sheet.png")
    ]
    assert (tmp_path / "out/a/sample_00.ply").read_bytes() != (tmp_path / "out/a_2/sample_00.ply").read_bytes()


def test_a_prediction_leaves_no_file_of_an_earlier_one_and_what_a_user_put_there(predict, tmp_path):
    image, folder = save(tmp_path / "a.png"), tmp_path / "out/a"
    predict.succeeds(image, "formats=[ply,glb]", "video=[orbit]", "maps=true")
    (folder / "sample_00_mine.ply").write_text("mine")
    again = predict.succeeds(image, "formats=[splat]")
    assert f"{folder}: an earlier prediction is replaced" in again.out + again.err
    kept = {"photo.png", "sample_00.splat", "sample_00_mine.ply", "sheet.png", "scene.json"}
    assert {path.name for path in folder.iterdir()} == kept


@pytest.mark.parametrize(("name", "status"), [("notes.txt", 0), ("depth_00.png", 2), ("photo.png", 2)])
def test_files_of_others_with_a_predictions_names_are_refused_and_kept(predict, tmp_path, name, status):
    (tmp_path / "out/a").mkdir(parents=True)
    (tmp_path / "out/a" / name).write_text("mine")
    done = predict(save(tmp_path / "a.png"))
    assert (done.status, f"{name} is there, which no prediction wrote" in done.err) == (status, status == 2)
    assert (tmp_path / "out/a" / name).read_text() == "mine"


def test_a_finished_prediction_is_not_repeated_unless_something_has_changed(predict, tmp_path, monkeypatch):
    images = [save(tmp_path / f"x/{name}.png") for name in "abc"]
    predict.succeeds(tmp_path / "x")

    def repeated(*settings: str) -> set[str]:
        out = predict(tmp_path / "x", *settings).out.splitlines()
        return {line.split()[1] for line in out if re.match(r"\d/\d ", line)}

    assert repeated() == set()
    (tmp_path / "out/a/scene.json").rename(tmp_path / "out/a/.unfinished")  # as a killed process leaves it
    (tmp_path / "out/b/sample_00.ply").unlink()
    assert repeated() == {"a.png:", "b.png:"}
    save(images[2], "blue")
    assert repeated() == {"c.png:"}
    assert repeated("seed=1") == {"a.png:", "b.png:", "c.png:"}
    assert repeated("seed=1", "shard=1", "shards=2") == set()


def test_shards_are_each_image_once_and_names_do_not_depend_on_them(predict, tmp_path):
    for place in ("x/a.png", "x/b.png", "y/a.png"):
        save(tmp_path / place)
    images = f"[{tmp_path / 'x'},{tmp_path / 'y'}]"
    assert "1/2 a.png" in predict(images, "shard=0", "shards=2").out
    assert sorted(path.name for path in (tmp_path / "out").glob("*/")) == ["a", "a_2", "shard-0"]
    assert "1/1 b.png" in predict(images, "shard=1", "shards=2").out
    predict.succeeds(images, "shard=3", "shards=4")  # nothing is left for it
    assert "shard=2: must lie between 0 and 1, for shards=2" in predict.refuses(images, "shard=2", "shards=2")


@pytest.mark.processes
def test_two_processes_predict_each_image_once_and_go_on_after_one_failed(command, tiny_weights, tmp_path):
    for name in ("a.png", "c.png", "d.png"):
        save(tmp_path / "x" / name)
    (tmp_path / "x/b.png").write_text("no image")
    given = [f"image={tmp_path / 'x'}", f"weights={tiny_weights}", f"out={tmp_path / 'out'}", *QUICK, "devices=2"]
    finished = command("predict", *given)
    assert (finished.status, finished.err.splitlines()[-1]) == (
        2,
        f"error: 1 of 4 images failed (b.png); the others are in {tmp_path / 'out'}",
    )
    assert re.search(r"^3 photos in \d+ s, [\d.]+ a minute \(devices=2\)$", finished.out, re.M)
    assert {path.parent.name for path in (tmp_path / "out").glob("*/scene.json")} == {"a", "c", "d"}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_prediction_on_a_gpu_is_that_on_the_cpu_up_to_rounding(command, tiny_weights, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    given = [f"image={save(tmp_path / 'a.png')}", f"weights={tiny_weights}", "samples=2", "steps=2", "color_fits=0"]
    command.succeeds("predict", *given, "video=[]", f"out={tmp_path / 'gpu'}")
    assert torch.cuda.max_memory_allocated() > 0
    monkeypatch.setattr(trained, "used_device", lambda: "cpu")
    command.succeeds("predict", *given, "video=[]", f"out={tmp_path / 'cpu'}")
    for sample in range(2):
        gpu, cpu = (read_gaussians(tmp_path / device / f"a/sample_{sample:02}.ply") for device in ("gpu", "cpu"))
        torch.testing.assert_close(gpu.means, cpu.means, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(gpu.colors, cpu.colors, rtol=1e-3, atol=1e-3)


def test_if_all_fail_nothing_is_said_to_be_left(predict, command, tmp_path):
    for name in ("x.png", "y.png"):
        (tmp_path / name).write_text("no image")
    assert predict("[x.png,y.png]").err.splitlines()[-1] == "error: 2 of 2 images failed (x.png, y.png)"
    finished = predict(tmp_path / "x.png")
    assert (finished.status, finished.err.count("\n")) == (2, 1)
    assert re.match("error: .*x.png", finished.err)
    assert not list((tmp_path / "out").glob("*/"))


def model_with(tiny_weights: Path, **facts: object) -> CompleteSplat:
    """The model with facts of its training."""
    model = CompleteSplat.from_pretrained(tiny_weights)
    model.architecture["training"] = facts
    return model


@pytest.mark.parametrize(("facts", "times"), [({}, 1), ({"box_masks": 0.0}, 1), ({"box_masks": 0.5}, 0)])
def test_one_warning_says_that_the_weights_were_not_trained_with_hidden_parts(
    predict, tiny_weights, tmp_path, monkeypatch, facts, times
):
    model = model_with(tiny_weights, **facts)
    monkeypatch.setattr(CompleteSplat, "from_pretrained", lambda *_: model)
    for name in ("a.png", "b.png"):
        save(tmp_path / "photos" / name)
    finished = predict(tmp_path / "photos", "box=[0,0,0.5,0.5]")
    warning = "box: these weights were not trained with parts of the image hidden"
    assert (finished.status, finished.out.count(warning)) == (0, times)


def test_the_background_can_be_removed(predict, tmp_path, monkeypatch):
    cut = []

    def without_background(image):
        cut.append(image)
        return image.convert("RGBA")

    monkeypatch.setattr("completesplat.photo.reading.without_background", without_background)
    for setting, removed in (("background=remove", True), ("background=1", False)):
        done = predict.succeeds(save(tmp_path / "a.png"), setting)
        assert ("a.png: removing the background" in done.out) == removed
        settings = strict_json(tmp_path / "out/a/scene.json")["settings"]
        assert (len(cut), settings.get("background")) == (1, "remove" if removed else None)


def test_a_field_of_view_is_of_the_whole_photo_also_if_an_object_needs_a_larger_square(predict, tmp_path):
    cut_out = Image.new("RGBA", (32, 96))
    cut_out.paste("blue", (10, 0, 22, 56))
    cut_out.save(tmp_path / "a.png")
    for settings in (["fov=50"], ["fov=50", "box=[0,0,0.5,0.5]"]):
        predict.succeeds(tmp_path / "a.png", *settings)
        assert strict_json(tmp_path / "out/a/scene.json")["settings"]["fov_degrees"] == pytest.approx(50)


def test_the_object_is_what_was_cut_out_or_differs_from_the_background_of_the_weights():
    image = Image.new("RGBA", (16, 16), "white")
    image.paste("blue", (2, 4, 6, 10))
    on_white = read_square(image, Framing(16))
    assert object_mask(on_white, None) is None
    expected = torch.zeros(1, 16, 16)
    expected[:, 4:10, 2:6] = 1
    assert torch.equal(object_mask(on_white, 1.0), expected)
    image.paste((0, 0, 0, 0), (8, 0, 16, 16))
    expected[:] = 1
    expected[..., 8:] = 0
    for background in (None, 1.0):
        assert torch.equal(object_mask(read_square(image, Framing(16)), background), expected)


def test_what_is_taken_of_a_photo_is_said_recorded_and_shown(predict, tmp_path):
    image = tmp_path / "a.png"
    Image.new("RGB", (30, 40), "red").save(image)
    whole = predict.succeeds(image)
    assert "a.png: its border is continued to a square\n" in whole.out
    settings = strict_json(tmp_path / "out/a/scene.json")["settings"]
    assert (settings["crop"], settings["photo_part"]) == ("whole", [0.125, 0, 0.875, 1])
    photo = Image.open(tmp_path / "out/a/photo.png")
    assert photo.getpixel((photo.width // 2, 0)) == (255, 0, 0)
    assert photo.getpixel((0, 0))[1] > 100  # pale
    cut = predict.succeeds(image, "crop=[0,0.25,1]")
    assert "a.png: 30 x 30 of its 30 x 40 pixels are taken, from (0, 10)\n" in cut.out
    settings = strict_json(tmp_path / "out/a/scene.json")["settings"]
    assert (settings["crop"], settings["photo_part"]) == ([0, 0.25, 1], [0, 0, 1, 1])
    Image.new("RGB", (40, 8), "red").save(image)
    assert "a.png: 24 x 8 of its 40 x 8 pixels are taken, from (8, 0); its border is" in predict.succeeds(image).out
    assert "crop=middle: choose one of whole, center" in predict.refuses(image, "crop=middle")


def test_videos_and_formats_are_written_and_recorded_and_a_strange_field_of_view_told(predict, tmp_path, monkeypatch):
    program = install(tmp_path / "bin", "splat-transform")
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    wanted = ["formats=[splat,sog,html]", "video=[swipe,wobble]", "frames=3", "fov=15"]
    finished = predict.succeeds(save(tmp_path / "a.png"), *wanted)
    assert "a.png: the field of view is 15 degrees (given), 50 in training" in finished.out
    folder = tmp_path / "out/a"
    written = {path.name for path in folder.iterdir()}
    videos = {"swipe_00.mp4", "wobble_00.mp4"}
    scenes = {"sample_00.splat", "sample_00.sog", "sample_00.html"}
    assert written == videos | scenes | {"photo.png", "sheet.png", "scene.json"}
    assert all(len(imageio.mimread(folder / name, memtest=False)) == 3 for name in videos)
    files = strict_json(folder / "scene.json")["files"]
    assert written - {"scene.json"} == set(files.values())
    assert (files["swipe_00"], files["wobble_00"]) == ("swipe_00.mp4", "wobble_00.mp4")
    assert len(calls(program)) == 3  # its version, before the model runs


def test_wishes_without_a_meaning_are_refused_before_the_model_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    for setting, message in (
        ("formats=html", "formats sog and html need Node.js"),
        ("formats=mesh", f"formats=[mesh] needs scikit-image: {install_command('mesh')}"),
        (
            "formats=[]",
            f"formats=[] video=[]: choose a format ({', '.join(FORMATS)}) or a video",
        ),
        ("mask=x.png", "mask=FILE belongs to one image"),
        ("image=nofile.jpg", "nofile.jpg: no such file"),
    ):
        images = f"image=[{save(tmp_path / 'a.png')},{save(tmp_path / 'b.png')}]"
        video = ["video=[]"] if setting == "formats=[]" else []
        config = compose_config("predict", images, "weights=nowhere", setting, *video)
        with pytest.raises(CompleteSplatError, match=re.escape(message)):
            run(config, tmp_path)
    only_videos = output_files(compose_config("predict", "image=a.png", "formats=[]"))
    assert (only_videos.formats, only_videos.videos) == ((), ("orbit",))


@pytest.mark.parametrize("broken", ["some", "all"])
def test_gaussians_that_are_not_finite_reach_no_file(predict, tmp_path, monkeypatch, broken):
    def damaged(*args, **settings):
        (scene,) = draw(*args, **settings)
        scene.opacities[: 7 if broken == "some" else None] = torch.nan
        return [scene]

    monkeypatch.setattr(CompleteSplat, "forward", damaged)
    finished = predict(save(tmp_path / "a.png"), "formats=[ply,splat]")
    if broken == "all":
        assert (finished.status, (tmp_path / "out/a").exists()) == (2, False)
        assert "a.png: sample 0: all 20 Gaussians are broken" in finished.err
        return
    assert finished.status == 0
    assert finished.out.count("left out 7 of 20 Gaussians") == 1
    assert strict_json(tmp_path / "out/a/scene.json")["settings"]["gaussians"] == [13]
    assert (tmp_path / "out/a/sample_00.splat").stat().st_size == 13 * 32
