"""Import of captures: cameras by COLMAP against those that the photos were drawn with, and what is refused."""

import errno
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from support import write_capture

from completesplat.data.captures import capture_images, films, importing
from completesplat.data.captures.captured_frames import CapturedFrame
from completesplat.data.captures.importing import image_pairs, import_capture
from completesplat.data.captures.module import read_capture
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.cameras import look_at
from completesplat.installation import install_command

pycolmap = pytest.importorskip("pycolmap")

CASES = Path(__file__).parents[1] / "cases"
FOCAL, WIDTH, HEIGHT = 260.0, 256, 192
PHOTOS = 8
ANGLES = np.linspace(0.25, 1.3, PHOTOS)


def world_to_camera(angle: float) -> np.ndarray:
    """A camera (OpenCV's axes) that looks into the corner of three walls."""
    eye = torch.tensor([5 * np.cos(angle), 5 * np.sin(angle), 2.5 + angle])
    return look_at(eye, torch.full_like(eye, 0.6), torch.tensor([0.0, 0, 1]).double()).numpy()


def draw_corner(pose: np.ndarray) -> Image.Image:
    """Three walls with random textures, by rays through the pixels' centres."""
    noise = np.random.default_rng(3).uniform(0, 255, (3, 48, 48)).astype(np.float32)
    walls = [np.asarray(Image.fromarray(wall).resize((480, 480), Image.Resampling.BICUBIC)) for wall in noise]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1) @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    depths = np.where(rays < 0, -eye / rays, np.inf)
    nearest = depths.argmin(axis=-1)
    hits = eye + np.minimum(depths.min(axis=-1, keepdims=True), 100) * rays
    pixels = np.zeros((HEIGHT, WIDTH))
    for axis, wall in enumerate(walls):
        u, v = (hits[..., [other for other in range(3) if other != axis]] * 96).astype(int).T % 480
        pixels = np.where(nearest == axis, wall[v.T, u.T], pixels)
    return Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).convert("RGB")


def distances(frames: tuple[CapturedFrame, ...]) -> tuple[np.ndarray, np.ndarray]:
    """After a similarity: distances of the frames from the true places, and angles from the true views in degrees."""
    true = np.linalg.inv([world_to_camera(angle) for angle in ANGLES])
    poses = np.linalg.inv([frame.world_to_camera for frame in frames])
    similarity = pycolmap.estimate_sim3d(poses[:, :3, 3], true[:, :3, 3])
    rotation = similarity.rotation.matrix()
    turns = Rotation.from_matrix(rotation @ poses[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1))
    places = similarity.scale * poses[:, :3, 3] @ rotation.T + similarity.translation
    return np.linalg.norm(places - true[:, :3, 3], axis=1), np.degrees(turns.magnitude())


def test_cameras_are_those_that_the_photos_were_drawn_with_and_a_photo_of_something_else_is_named(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / "my corner/images").mkdir(parents=True)
    for number, angle in enumerate(ANGLES):
        draw_corner(world_to_camera(angle)).save(tmp_path / f"my corner/images/photo {number}.png")
    Image.effect_noise((WIDTH, HEIGHT), 90).save(tmp_path / "my corner/images/noise.png")
    given = str(tmp_path / "my corner"), "colmap", 100, 1000, tmp_path / "out"
    command, capture = import_capture(*given), tmp_path / "out/my corner"
    assert "COLMAP finds poses for 8 of 9 images, and leaves out: noise.png" in caplog.text
    assert "my corner: 8 images with cameras, of which 3 are held out" in caplog.text
    assert command == f"go on with: completesplat fit experiment=capture 'data.root={capture}'"
    assert sorted(path.name for path in capture.iterdir()) == ["images", "sparse"]
    frames = read_capture(capture).frames
    assert [frame.image.name for frame in frames] == [f"photo_{number}.png" for number in range(PHOTOS)]
    away, angles = distances(frames)
    assert away.max() < 0.02  # of 5
    assert angles.max() < 0.5
    assert frames[0].lens.focal == pytest.approx((FOCAL, FOCAL), rel=0.02)
    with pytest.raises(DataError, match="my corner: exists already"):
        import_capture(*given)


def test_all_pairs_are_matched_or_those_of_neighbours_in_a_ring():
    assert image_pairs(6, sequential=False) == [(a, b) for a in range(6) for b in range(a + 1, 6)]
    assert image_pairs(21, sequential=True) == image_pairs(21, sequential=False)  # all are neighbours
    pairs = image_pairs(100, sequential=True)
    assert {(0, 1), (0, 10), (0, 99), (5, 95), (3, 35)} <= set(pairs)
    assert not {(0, 11), (20, 35), (0, 50)} & set(pairs)
    assert all(sum(number in pair for pair in pairs) == 2 * (10 + 2) for number in range(100))  # and 16, 32 apart


def copied(photos: Path, images: Path) -> list[str]:
    """Names of the images that an import would use."""
    images.mkdir()
    capture_images.copy_photos(photos, images)
    return sorted(path.relative_to(images).as_posix() for path in images.glob("**/*.*"))


def test_photos_become_upright_keep_their_focal_length_and_the_unusable_are_named(tmp_path, caplog, monkeypatch):
    images = tmp_path / "images"
    photo, exif = Image.new("RGB", (40, 30)), Image.Exif()
    photo.paste((255, 255, 255), (0, 0, 20, 30))  # its left half
    exif[274], exif.get_ifd(0x8769)[41989] = 6, 28  # it is to be turned clockwise; focal length in 35 mm film
    for name in ("a b.jpg", "c.TIFF", "a_b.png"):
        photo.save(tmp_path / name, exif=exif)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a b.jpg").read_bytes()[:-200])
    (tmp_path / "notes.txt").touch()
    os.mkfifo(tmp_path / "pipe.png")
    assert copied(tmp_path, images) == ["a_b.jpg", "a_b_2.png", "c.png"]
    for copy in images.iterdir():
        image = Image.open(copy)
        assert image.size == (30, 40)
        upper, lower = (np.asarray(image.crop(box)).mean() for box in ((0, 0, 30, 19), (0, 21, 30, 40)))
        assert upper > 250 > 5 > lower
        assert image.getexif().get(274) is None
        assert copy.stem == "c" or image.getexif().get_ifd(0x8769)[41989] == 28
    assert caplog.text.count("left out: ") == 2
    assert "left out: 1 file of other formats: notes.txt" in caplog.text
    assert f"left out: {tmp_path / 'cut.jpg'}: cannot be decoded" in caplog.text
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(capture_images.saving, "save_image", full)
    with pytest.raises(OSError, match="No space left"):
        capture_images.copy_photos(tmp_path, images)


def test_photos_are_written_in_a_format_that_holds_them_whatever_their_names_say(tmp_path):
    colors = Image.radial_gradient("L").convert("RGB")
    colors.save(tmp_path / "lzw.tif", compression="tiff_lzw")
    colors.convert("CMYK").save(tmp_path / "print.png", format="TIFF")
    colors.quantize(64).save(tmp_path / "palette.jpg", format="PNG")
    colors.convert("RGBA").save(tmp_path / "screenshot.jpg", format="PNG")
    colors.save(tmp_path / "web.webp")
    expected = ["lzw.png", "palette.png", "print.png", "screenshot.png", "web.jpg"]
    assert copied(tmp_path, tmp_path / "images") == expected
    for path in (tmp_path / "images").iterdir():
        difference = np.asarray(Image.open(path).convert("RGB"), dtype=float) - np.asarray(colors)
        assert np.abs(difference).mean() < 4


def test_colmap_gets_the_photos_in_the_order_of_their_numbers(tmp_path, monkeypatch):
    for camera in ("cam.1", "cam.2"):
        (tmp_path / "film" / camera).mkdir(parents=True)
        for number in range(12):
            Image.new("L", (8, 8)).save(tmp_path / f"film/{camera}/f{number}.png")
    given = Mock(side_effect=DataError("enough"))
    monkeypatch.setattr(importing, "_find_cameras", given)
    with pytest.raises(DataError, match="enough"):
        import_capture(str(tmp_path / "film"), "colmap", 100, 1000, tmp_path / "out")
    ends = {"cam.1": ".png", "cam.2": "_2.png"}
    assert given.call_args.args[1] == [f"{camera}/f{number}{ends[camera]}" for camera in ends for number in range(12)]


@pytest.mark.parametrize(("asked", "expected"), [(8, range(0, 40, 5)), (100, range(40))])
def test_a_video_is_split_into_evenly_spread_frames_unless_they_are_too_large(tmp_path, monkeypatch, asked, expected):
    grey = np.arange(40, dtype=np.uint8) * 6
    imageio.imwrite(tmp_path / "a.mp4", np.broadcast_to(grey[:, None, None, None], (40, 64, 64, 3)), fps=10)
    (images := tmp_path / "100%d images").mkdir()
    films.split_video(tmp_path / "a.mp4", images, asked)
    means = [np.asarray(Image.open(path)).mean() for path in sorted(images.iterdir())]
    np.testing.assert_allclose(means, 6 * np.array(expected), atol=2)
    monkeypatch.setattr(films.files, "MOST_PIXELS", 64 * 64 - 1)
    with pytest.raises(DataError, match=r"a\.mp4: ffmpeg finds no video of at most 4,095 pixels there"):
        films.split_video(tmp_path / "a.mp4", images, asked)


def test_what_makes_no_capture_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    def line(path: str, cameras: str | None = "colmap") -> str:
        with pytest.raises(CompleteSplatError) as caught:
            import_capture(path, cameras, 100, 1000, Path("out"))
        return str(caught.value)

    monkeypatch.chdir(tmp_path)
    Path("blank").mkdir()
    for number in range(5):
        Image.new("RGB", (64, 48)).save(f"blank/{number}.png")
    assert line("blank") == "blank: 5 usable images; a capture needs 6"
    Image.new("RGB", (64, 48)).save("blank/5.png")
    assert line("blank").startswith("blank: COLMAP finds poses for 0 of 6 images; a capture needs 6: take more")
    assert line("blank", None).endswith("get cameras by: completesplat data import blank cameras=colmap")
    Path("-a.mp4").write_bytes(bytes(1000))
    assert line("-a.mp4") == "-a.mp4: ffmpeg finds no video of at most 64,000,000 pixels there"
    assert line("typo") == "typo: no such file or folder"
    assert not list(Path("out").iterdir())
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert line("blank").endswith(f"cameras=colmap need pycolmap: {install_command('colmap')}")


def test_a_capture_stays_where_it_is_and_the_last_line_goes_on(command, tmp_path):
    write_capture(tmp_path / "fox", frames=20)
    for number in (3, 17):
        (tmp_path / f"fox/frame{number}.png").unlink()
    finished = command.succeeds("data", "import", "fox", "out=out")
    assert "2 of 20 frames have no image and are left out: frame3.png, frame17.png" in finished.out
    assert "fox: 18 images with cameras, of which 3 are held out" in finished.out
    last = [str(tmp_path / "out"), "go on with: completesplat fit experiment=capture data.root=fox"]
    assert finished.out.splitlines()[-2:] == last
    (tmp_path / "several").mkdir()
    for name in ("a", "b"):
        write_capture(tmp_path / "several" / name, frames=20)
    several = command("data", "import", "several", "out=out")
    assert several.out.splitlines()[-1].endswith(" data.root=several/a")  # one is fitted at a time


@pytest.mark.processes
def test_pycolmap_leaves_the_signal_that_ends_a_program_to_the_program():
    lines = [
        "import os, signal, sys",
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(9))",
        "from completesplat.data.captures.captured_frames import import_pycolmap",
        "import_pycolmap()",
        "os.kill(os.getpid(), signal.SIGTERM)",
    ]
    assert subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True).returncode == 9


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("reconstruction.json", "opensfm export_colmap"),
        ("a.r3d", "ns-process-data record3d"),
        ("cameras.xml", "ns-process-data metashape"),
    ],
)
def test_captures_of_other_programs_are_named_with_what_converts_them(tmp_path, name, command):
    (tmp_path / name).touch()
    with pytest.raises(DataError, match=command):
        import_capture(str(tmp_path), None, 100, 1000, tmp_path / "out")


def write_photos(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        Image.new("RGB", (40, 30), (90, 90, 90)).save(folder / name, "JPEG")


def test_heic_photos_are_read_and_files_of_other_formats_are_counted_and_named(tmp_path, caplog):
    folder = tmp_path / "photos"
    write_photos(folder, [f"IMG_{number}.jpg" for number in range(3)])
    shutil.copy(CASES / "heic/turned.heic", folder / "IMG_3.HEIC")
    (folder / "IMG_4.MOV").write_bytes(b"film")
    copies = copied(folder, tmp_path / "images")
    assert "left out: 1 file of other formats: IMG_4.MOV" in caplog.text
    assert len(copies) == 4
    images = [Image.open(tmp_path / "images" / name) for name in copies]
    assert [image.format for image in images] == ["JPEG"] * 4
    assert sorted({image.size for image in images}) == [(40, 30), (48, 64)]  # the last one is turned by EXIF


def test_photos_in_folders_are_those_of_one_camera_each(tmp_path, monkeypatch):
    for name in ("left eye", "right"):
        write_photos(tmp_path / "photos" / name, ["0 a.jpg", "1.jpg", "2.jpg"])
    write_photos(tmp_path / "photos/.thumbnails", ["0.jpg"])
    (tmp_path / "photos/right/._2.jpg").touch()  # as macOS leaves them
    names = copied(tmp_path / "photos", tmp_path / "images")
    assert [name.partition("/")[0] for name in names] == ["left_eye"] * 3 + ["right"] * 3
    assert not any(" " in name for name in names)
    importer = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(pycolmap, "import_images", importer)
    with pytest.raises(KeyboardInterrupt):
        importing._find_cameras(tmp_path, names, False, 1000)
    assert importer.call_args.args[2] == pycolmap.CameraMode.PER_FOLDER


def test_what_an_interrupted_import_leaves_is_no_capture_and_the_way_out_is_said(tmp_path, caplog):
    write_capture(tmp_path / "out", 9)
    (tmp_path / "out").rename(tmp_path / ".fox.unfinished")
    for root in (tmp_path, tmp_path / "fox"):
        caplog.clear()
        with pytest.raises(DataError, match=r"no cameras there|no such file"):
            import_capture(str(root), None, 100, 1000, Path("out"))
        assert f"{tmp_path}/.fox.unfinished: left by an import that was interrupted: start it again" in caplog.text
