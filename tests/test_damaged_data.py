"""Damaged data sets, each kind of damage for each reader: one line names the place, and nothing else is lost."""

import hashlib
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import meshes
import numpy as np
import pyarrow as pa
import pytest
import torch
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SIZE, depth_bits
from damages import Refused, both, content, cut, gone, intact, longer, must_read_whole, must_refuse, replaced, rows
from PIL import Image
from readers import CLIPS, Damage, edit, put, write_chunks, write_texts
from realestate10k_trees import StoredClip, chunk_entry, make_clip

from completesplat.errors import (
    BadAnnotation,
    BadCamera,
    BadImage,
    BadPlacement,
    ChangedFile,
    DataError,
    MissingFile,
    OutsidePath,
    TooFewFrames,
    UnreadableFile,
)

NAN = float("nan")


# CO3D.


def turned(angle: float, stretch: float = 1.0) -> list[list[float]]:
    """Return a rotation about the z axis, whose third axis is stretched."""
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, stretch]]


def black(file: str, mode: str) -> Damage:
    """Write an image with its sides exchanged."""
    return lambda folder: Image.new(mode, SIZE[::-1]).save(folder / file)


def unknown_depth(folder: Path) -> None:
    for number in range(1, 5):
        path = folder / CATEGORY / f"a/depths/frame00000{number}.png"
        Image.fromarray(depth_bits(np.zeros((24, 32)))).save(path)


def moved_outside(folder: Path) -> None:
    images = folder / CATEGORY / "a/images"
    images.rename(folder.with_name("elsewhere"))
    images.symlink_to(folder.with_name("elsewhere"))


F = f"{CATEGORY}/{FRAMES}"
S = f"{CATEGORY}/{SEQUENCES}"
L = f"{CATEGORY}/{SET_LIST}"
IMAGE = f"{CATEGORY}/a/images/frame000002.png"
MASK = f"{CATEGORY}/a/masks/frame000002.png"
DEPTH = f"{CATEGORY}/a/depths/frame000002.png"
CLOUD = f"{CATEGORY}/a/pointcloud.ply"
ALL = [0, 1, 2, 3]
F2 = f"{F}, a, frame 2"
NO_CLOUD = put(S, "0.point_cloud", None)
OTHER_FORMAT = put(F, "2.viewpoint.intrinsics_format", "screen")
UNKNOWN_FRAME = edit(L, lambda lists: lists["train"].append(["a", 99]))
CO3D = [
    Refused(put(F, "2.viewpoint", ...), BadAnnotation, F2, "no viewpoint", [2]),
    Refused(put(F, "2.viewpoint.R", ...), BadAnnotation, F2, "R must be 3 x 3 numbers", [2]),
    Refused(put(F, "2.viewpoint.R", turned(0.3, 1.001)), BadCamera, F2, "R is not orthonormal", [2]),
    Refused(put(F, "2.viewpoint.R", turned(0.3, -1.0)), BadCamera, F2, "R is a reflection", [2]),
    Refused(put(F, "2.viewpoint.R", turned(0.3, NAN)), BadAnnotation, F2, "R is not finite", [2]),
    Refused(put(F, "2.viewpoint.T", [0.0, 1e200, 4.0]), BadAnnotation, F2, "T is not finite in float32", [2]),
    Refused(put(F, "2.viewpoint.focal_length", [0, 2]), BadCamera, F2, "focal_length must be positive", [2]),
    Refused(put(F, "2.viewpoint.principal_point", [0, 1.2]), BadCamera, F2, "lies outside of the 32 x 24 image", [2]),
    Refused(OTHER_FORMAT, BadAnnotation, F2, "unknown intrinsics format 'screen'", [2]),
    Refused(put(F, "2.image.size", [0, 32]), BadAnnotation, F2, "two positive integers", [2]),
    Refused(put(F, "2.image.size", [10**400, 24]), BadAnnotation, F2, "two positive integers", [2]),
    Refused(put(F, "2.mask", None), BadAnnotation, F2, "mask must be of type dict", [2]),
    Refused(put(F, "2.depth.scale_adjustment", NAN), BadAnnotation, F2, "scale_adjustment is not finite", [2]),
    Refused(put(F, "2.image.path", 7), BadAnnotation, F2, "path must be of type str", [2]),
    Refused(put(F, "2.image.path", "things/../../x.jpg"), OutsidePath, F2, "outside", [2]),
    Refused(put(F, "2.image.path", "things/\ud800.jpg"), OutsidePath, F2, "no file name has", [2]),
    Refused(edit(F, lambda frames: [None, *frames]), BadAnnotation, F, "entry 0: no sequence_name", []),
    Refused(put(F, "2.frame_number", ...), BadAnnotation, f"{F}, a", "no frame_number", [2]),
    # It is not known whose entry this was: its frame is missing, too.
    Refused(put(F, "2.sequence_name", 0), BadAnnotation, F, "entry 2: seq", [2], 1),
    Refused(edit(F, lambda frames: [*frames, frames[2]]), BadAnnotation, F2, "annotated twice", []),
    Refused(edit(S, lambda sequences: [*sequences, sequences[0]]), BadAnnotation, f"{S}, a", "annotated twice", []),
    Refused(put(S, "0.point_cloud.path", "../x"), OutsidePath, f"{S}, a", "outside", ALL),
    Refused(put(S, "0.viewpoint_quality_score", "1"), BadAnnotation, f"{S}, a", "must be a number", ALL),
    Refused(edit(S, lambda sequences: sequences[1:]), BadAnnotation, f"{S}, a", "not annotated", ALL),
    Refused(edit(F, lambda frames: {"frames": frames}), BadAnnotation, F, "must hold a list"),
    Refused(edit(L, lambda lists: [lists]), BadAnnotation, L, "no train"),
    Refused(edit(L, lambda lists: lists["train"].append(["a"])), BadAnnotation, L, "expected", []),
    Refused(UNKNOWN_FRAME, BadAnnotation, f"{L}, a, frame 99", "not annotated", []),
    Refused(cut(F, 100), UnreadableFile, F, ""),
    Refused(cut(S, 100), UnreadableFile, S, ""),
    Refused(cut(L, 100), UnreadableFile, L, ""),
    Refused(gone(F), MissingFile, F, "no such file"),
    Refused(gone(S), MissingFile, S, "no such file"),
    Refused(gone(L), DataError, f"{CATEGORY}/set_lists", "no set list 'fewview_dev'"),
    Refused(moved_outside, OutsidePath, f"{F}, a, frame 0", "leads outside", ALL, 3),
    Refused(black(IMAGE, "RGB"), BadImage, f"{IMAGE}, a, frame 1", "", [1]),
    Refused(black(MASK, "L"), BadImage, f"{MASK}, a, frame 1", "", [1]),
    Refused(content(IMAGE, b"image"), BadImage, f"{IMAGE}, a, frame 1", "", [1]),
    Refused(gone(MASK), MissingFile, f"{MASK}, a, frame 1", "no such file", [1]),
    Refused(replaced(IMAGE, os.mkfifo), MissingFile, f"{IMAGE}, a, frame 1", "no such file", [1]),
    Refused(gone(CLOUD), MissingFile, f"{CLOUD}, a", "no such file", ALL),
    Refused(both(NO_CLOUD, gone(DEPTH)), MissingFile, f"{DEPTH}, a, frame 1", "no such file", ALL),
    Refused(both(NO_CLOUD, put(F, "1.depth.scale_adjustment", 0)), BadImage, f"{DEPTH}, a, frame 1", "", ALL),
    Refused(both(NO_CLOUD, unknown_depth), BadPlacement, "a", "", ALL),
]


# RealEstate10K, as text files and in chunks.


def row(number: int, column: int | slice, value: object) -> Callable[[StoredClip], object]:
    return lambda clip: clip.rows[number].__setitem__(column, value)


def image(frame: int, make: Callable[[bytes], bytes]) -> Callable[[StoredClip], object]:
    return lambda clip: clip.images.__setitem__(frame, make(clip.images[frame]))


def reflection(clip: StoredClip) -> None:
    clip.rows[2, 6:10] *= -1


def one_frame(clip: StoredClip) -> None:
    clip.timestamps = clip.timestamps[:1]
    clip.rows = clip.rows[:1]
    clip.images = clip.images[:1]


OTHER_SIZE = make_clip("x", size=(32, 18)).images[0]
# Changes of a clip in whichever form it is stored: (change, kind, frame, reason).
CLIP = [
    (row(2, 9, np.nan), BadAnnotation, 2, "not finite"),
    (row(2, 9, 1e30), BadAnnotation, 2, "not finite in float32"),
    (reflection, BadCamera, 2, ""),
    (row(2, 6, 1.01), BadCamera, 2, "not a rotation and translation"),
    (row(3, 1, 0), BadCamera, 3, ""),
    (row(2, 4, 0.1), BadCamera, 2, ""),
    (one_frame, TooFewFrames, None, ""),
    (image(2, lambda data: data[: len(data) // 2]), BadImage, 2, ""),
    (image(0, lambda _: b"<html>404</html>"), BadImage, 0, ""),
    (image(2, lambda _: OTHER_SIZE), BadImage, 2, ""),
]
T = "train/bad.txt"
C = "train/000000.torch"
INDEX = "train/index.json"


def stored(write: Callable[[Path, list[StoredClip]], None]) -> list[Refused]:
    """Return the rows of `CLIP` for a form; only the text form has a file for each image."""
    table = []
    for change, kind, frame, reason in CLIP:

        def damage(folder: Path, change: Callable[[StoredClip], object] = change) -> None:
            clip = make_clip("bad", frames=4)
            change(clip)
            shutil.rmtree(folder / "train")
            write(folder, [clip, *CLIPS[1:]])

        file = C
        if write is write_texts:
            file = f"train/bad/{33_000 * (frame + 1)}.jpg" if kind is BadImage else T
        place = f"{file}, bad" if frame is None else f"{file}, bad, frame {frame}"
        table.append(Refused(damage, kind, place, reason))
    return table


def columns(number: int, change: Callable[[list[str]], list[str]]) -> Damage:
    """Change the columns of a frame's line."""

    def damage(folder: Path) -> None:
        lines = (folder / T).read_text().splitlines()
        lines[1 + number] = " ".join(change(lines[1 + number].split()))
        (folder / T).write_text("\n".join(lines))

    return damage


TEXTS = [
    *stored(write_texts),
    Refused(content(T, CLIPS[0].images[0]), UnreadableFile, f"{T}, bad", ""),
    Refused(replaced(T, Path.mkdir), MissingFile, f"{T}, bad", ""),
    Refused(columns(1, lambda line: [*line, "0"]), BadAnnotation, f"{T}, bad, frame 1", ""),
    Refused(columns(2, lambda line: [*line[:5], "k1", *line[6:]]), BadAnnotation, f"{T}, bad, frame 2", ""),
    Refused(columns(2, lambda line: ["66000", *line[1:]]), BadAnnotation, f"{T}, bad, frame 1", ""),
    Refused(columns(2, lambda line: ["98999", *line[1:]]), MissingFile, "train/bad/98999.jpg, bad, frame 2", ""),
]


def chunk(make: Callable[[dict], object]) -> Damage:
    return lambda folder: torch.save(make(chunk_entry(CLIPS[0])), folder / C)


def entry(**fields: object) -> Damage:
    return chunk(lambda whole: [whole | fields])


def linked_chunk(folder: Path) -> None:
    shutil.copy(folder / C, folder / "0.torch")
    (folder / "train/link.torch").symlink_to("../0.torch")
    put(INDEX, "d", "link.torch")(folder)


TWICE = torch.tensor([0, 1, 2, 1])
LARGE = torch.zeros(1, dtype=torch.uint8).expand(10**6)
CHUNKS = [
    *stored(write_chunks),
    Refused(entry(cameras=torch.zeros(4, 17)), BadAnnotation, f"{C}, bad", "18 columns"),
    Refused(entry(cameras=torch.zeros(3, 18)), BadAnnotation, f"{C}, bad", "4 images, 3 cameras and 4 timestamps"),
    Refused(entry(timestamps=torch.arange(4.0)), BadAnnotation, f"{C}, bad", "timestamps are not int64"),
    Refused(entry(timestamps=TWICE), BadAnnotation, f"{C}, bad, frame 1", "another frame has its time"),
    Refused(entry(images=[LARGE] * 4), BadAnnotation, f"{C}, bad", "images are not a list"),
    Refused(cut(C, -500), UnreadableFile, f"{C}, bad", ""),
    Refused(chunk(lambda whole: list(whole["images"])), BadAnnotation, f"{C}, bad", ""),
    Refused(chunk(lambda whole: [whole, whole]), BadAnnotation, f"{C}, bad", ""),
    Refused(chunk(lambda whole: [whole | {"key": "other"}]), BadAnnotation, f"{C}, bad", ""),
    Refused(put(INDEX, "b", "../0.torch"), OutsidePath, f"{INDEX}, b", "leads outside"),
    Refused(put(INDEX, "c", "/0.torch"), OutsidePath, f"{INDEX}, c", "another machine"),
    Refused(linked_chunk, OutsidePath, f"{INDEX}, d", "links may not leave it"),
    Refused(put(INDEX, "e", ""), OutsidePath, f"{INDEX}, e", "leads outside of train, or nowhere"),
]


# Captures: transforms.json, and COLMAP's binary models.

J = "transforms.json"
POSE = "frames.5.transform_matrix.0.3"
TWICE_NAMED = put(J, "frames.2.file_path", "./frame1")
FISHEYE = put(J, "camera_model", "OPENCV_FISHEYE")
WIDE = both(put(J, "fl_x", ...), put(J, "camera_angle_x", 3.2))
TRANSFORMS = [
    Refused(content(J, b"null"), BadAnnotation, f"{J}, input", "no frames in"),
    Refused(content(J, b"[]"), BadAnnotation, f"{J}, input", "no frames in"),
    Refused(content(J, b"7"), BadAnnotation, f"{J}, input", "no frames in"),
    Refused(content(J, b'"frames"'), BadAnnotation, f"{J}, input", "no frames in"),
    Refused(content(J, b"{}"), BadAnnotation, f"{J}, input", "no frames in"),
    Refused(edit(J, lambda c: c | {"frames": c["frames"][:5]}), TooFewFrames, f"{J}, input", "at least 6"),
    Refused(put(J, "frames.3.transform_matrix.0.3", NAN), BadAnnotation, f"{J}, input, frame 3", "not finite"),
    Refused(put(J, POSE, 1e200), BadAnnotation, f"{J}, input, frame 5", "not finite in float32: "),
    Refused(put(J, POSE, -1e300), BadAnnotation, f"{J}, input, frame 5", "not finite in float32: "),
    Refused(put(J, POSE, 1e25), BadAnnotation, f"{J}, input, frame 5", "not finite in float32: "),
    Refused(put(J, "frames.3.transform_matrix.0.0", 0.3), BadCamera, f"{J}, input, frame 3", "not orthonormal"),
    Refused(put(J, "frames.3.transform_matrix.3.0", 0.1), BadCamera, f"{J}, input, frame 3", "matrix ends in the row"),
    Refused(TWICE_NAMED, BadAnnotation, f"{J}, input, frame 2", "the same image as frame 1"),
    Refused(put(J, "frames.2.file_path", "../frame2.png"), OutsidePath, f"{J}, input, frame 2", "leads outside"),
    Refused(put(J, "frames.4.mask_path", "m.png"), MissingFile, "m.png, input, frame 4", "no such file"),
    Refused(put(J, "fl_x", ...), BadAnnotation, f"{J}, input, frame 0", "neither fl_x nor camera_angle_x"),
    Refused(put(J, "frames.1.fl_y", -2.0), BadCamera, f"{J}, input, frame 1", "must be positive"),
    Refused(WIDE, BadCamera, f"{J}, input, frame 0", "view of 3.2"),
    Refused(put(J, "frames.1.cx", 16.0), BadCamera, f"{J}, input, frame 1", "principal point (16, 6) lies outside"),
    Refused(FISHEYE, BadCamera, f"{J}, input, frame 0", "OPENCV_FISHEYE is not supported"),
    Refused(put(J, "is_fisheye", True), BadCamera, f"{J}, input, frame 0", "is_fisheye is not supported"),
    Refused(put(J, "k4", 0.1), BadCamera, f"{J}, input, frame 0", "k4 = 0.1 has no meaning for camera model OPENCV"),
    Refused(put(J, "ply_file_path", J), UnreadableFile, f"{J}, input", "not a point cloud"),
]
COLMAP = []
for name in ("cameras", "images", "points3D"):
    file = f"sparse/0/{name}.bin"
    COLMAP += [
        Refused(longer(file), DataError, f"{file}, input", "cut off"),
        Refused(cut(file, 1), DataError, f"{file}, input", "cut off"),
        Refused(cut(file, -1), DataError, f"{file}, input", "cut off"),
    ]


# Latents, kept by `data latents`.


def in_store(damage: Damage) -> Damage:
    return lambda folder: damage(next(folder.rglob("manifest.json")).parent)


def signed(keys: str, value: object) -> Damage:
    """Change a manifest, and its checksum accordingly."""
    change = both(put("manifest.json", keys, value), put("manifest.json", "sha256", "0" * 64))

    def damage(folder: Path) -> None:
        change(folder)
        text = (folder / "manifest.json").read_text()
        digest = hashlib.sha256(text.encode()).hexdigest()
        (folder / "manifest.json").write_text(text.replace("0" * 64, digest))

    return in_store(damage)


def zeros(folder: Path) -> None:
    path = folder / "latents.arrow"
    path.write_bytes(bytes(path.stat().st_size))


def fewer_columns(folder: Path) -> None:
    """Write a table of the same size that has some of the columns only."""
    path = folder / "latents.arrow"
    size = path.stat().st_size
    table = pa.ipc.open_stream(path.read_bytes()).read_all().select(["name", "mean"])
    with pa.ipc.new_stream(path, table.schema) as writer:
        writer.write_table(table)
    path.write_bytes(path.read_bytes().ljust(size, b"\0"))


M = "manifest.json"
A = "latents.arrow"
LATENTS = [
    Refused(in_store(cut(A, -1)), ChangedFile, A, "another size"),
    Refused(in_store(longer(A)), ChangedFile, A, "another size"),
    Refused(in_store(zeros), UnreadableFile, A, "damaged"),
    Refused(in_store(gone(A)), MissingFile, A, "no such file"),
    Refused(in_store(fewer_columns), ChangedFile, A, "not what the manifest describes"),
    Refused(in_store(cut(M, -20)), DataError, M, "not a JSON file"),
    Refused(in_store(put(M, "std.0", 7.5)), ChangedFile, M, "its checksum is another"),
    Refused(signed("format", 99), DataError, M, ""),
    Refused(signed("shapes.mean", [4, 2]), DataError, f"{A}, c0", "damaged"),
    Refused(signed("origin.precision", "object"), DataError, M, ""),
    Refused(signed("bytes", 3), DataError, A, ""),
    Refused(signed("origin.frames", "all"), DataError, M, ""),
]


# Meshes to render.


def obj(texture: str, library: str = "a.mtl") -> Damage:
    """Write a triangle with a texture."""
    return lambda folder: meshes.write_textured(folder / "meshes/sub", texture, library)


def gltf(texture: str) -> Damage:
    return lambda folder: meshes.write_gltf(folder / "meshes/sub/a.gltf", texture)


def glb(texture: str) -> Damage:
    """Write a triangle with a texture in glTF's binary form."""

    def damage(folder: Path) -> None:
        path = meshes.write_gltf(folder / "meshes/sub/a.gltf", texture)
        text = path.read_bytes()
        text += b" " * (-len(text) % 4)
        sizes = b"".join(size.to_bytes(4, "little") for size in (2, 20 + len(text), len(text)))
        path.with_suffix(".glb").write_bytes(b"glTF" + sizes + b"JSON" + text)
        path.unlink()

    return damage


def pipe(folder: Path) -> None:
    os.mkfifo(folder / "meshes/sub/t.png")


def private_link(folder: Path) -> None:
    (folder / "meshes/sub/t.png").symlink_to(folder / "outside/private.png")


LIES = "lies outside of the folder of meshes"
MESHES = [
    Refused(obj("../../outside/private.png"), DataError, "", f"private.png {LIES}"),
    Refused(obj("t.png", "../../outside/private.mtl"), DataError, "", f"private.mtl {LIES}"),
    Refused(both(private_link, gltf("t.png")), DataError, "", f"t.png {LIES}"),
    Refused(glb("..%2F../outside/private.png"), DataError, "", f"private.png {LIES}"),
    Refused(both(pipe, obj("t.png")), DataError, "", "t.png is no regular file"),
    Refused(both(pipe, gltf("t.png")), DataError, "", "t.png is no regular file"),
    # A place on another machine; Blender takes the file of that name beside the mesh.
    Refused(both(pipe, obj("C:\\work\\t.png")), DataError, "", "t.png is no regular file"),
]

TABLES = {
    "co3d": CO3D,
    "texts": TEXTS,
    "chunks": CHUNKS,
    "transforms": TRANSFORMS,
    "colmap": COLMAP,
    "latents": LATENTS,
    "meshes": MESHES,
}


@pytest.mark.parametrize("reader", sorted(TABLES.keys() - {"meshes"}))
def test_an_intact_input_is_read_whole(reader, built_once):
    must_read_whole(reader, built_once)


@pytest.mark.parametrize(("reader", "expected"), rows(TABLES))
def test_damage_is_refused_in_one_line_that_names_its_place(reader, expected, built_once, tmp_path):
    must_refuse(reader, expected, intact(reader, built_once), tmp_path / "input")
