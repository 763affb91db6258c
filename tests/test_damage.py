"""Every kind of damage, for every reader of files: one line that names the file, and nothing else is lost."""

import hashlib
import math
import os
import shutil
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import meshes
import numpy as np
import pyarrow as pa
import pytest
import torch
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SIZE, depth_bits
from PIL import Image
from pretrained_vaes import BIN, SAFETENSORS, rewrite
from published_weights import write_published
from readers import CLIPS, READERS, VAE, Damage, Usable, edit, put, write_chunks, write_texts
from realestate10k_trees import StoredClip, chunk_entry, make_clip

from completesplat.baselines.splatter_image.model import STATE
from completesplat.errors import (
    BadAnnotation,
    BadCamera,
    BadImage,
    BadPlacement,
    ChangedFile,
    CompleteSplatError,
    DataError,
    MissingFile,
    OutsidePath,
    PlyError,
    TooFewFrames,
    UnreadableFile,
    WeightsError,
)

NAN, INF = float("nan"), float("inf")


# Damage of the input in a folder.


def content(file: str, data: bytes) -> Damage:
    return lambda folder: (folder / file).write_bytes(data)


def cut(file: str, size: int) -> Damage:
    """Keep the first bytes; a negative size counts from the end."""
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:size])


def longer(file: str) -> Damage:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes() + b"\0")


def gone(file: str) -> Damage:
    return lambda folder: (folder / file).unlink()


def replaced(file: str, make: Callable[[Path], object]) -> Damage:
    return lambda folder: ((folder / file).unlink(), make(folder / file))


def both(*damages: Damage) -> Damage:
    return lambda folder: [damage(folder) for damage in damages]


# Damage of one format.


def turned(angle: float, stretch: float = 1.0) -> list[list[float]]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, stretch]]


def pose(row: int, column: int, value: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix.tolist()


def black(file: str, mode: str) -> Damage:
    return lambda folder: Image.new(mode, SIZE[::-1]).save(folder / file)


def unknown_depth(folder: Path) -> None:
    for number in range(1, 5):
        path = folder / CATEGORY / f"a/depths/frame00000{number}.png"
        Image.fromarray(depth_bits(np.zeros((24, 32)))).save(path)


def moved_outside(folder: Path) -> None:
    images = folder / CATEGORY / "a/images"
    images.rename(folder.with_name("elsewhere"))
    images.symlink_to(folder.with_name("elsewhere"))


def stored(change_clip: Callable[[StoredClip], object], write: Callable[[Path, list[StoredClip]], None]) -> Damage:
    """Write the first clip changed."""

    def damage(folder: Path) -> None:
        clip = make_clip("bad", frames=4)
        change_clip(clip)
        shutil.rmtree(folder / "train")
        write(folder, [clip, *CLIPS[1:]])

    return damage


def row(number: int, column: int | slice, value: object) -> Callable[[StoredClip], object]:
    return lambda clip: clip.rows[number].__setitem__(column, value)


def image(frame: int, make: Callable[[bytes], bytes]) -> Callable[[StoredClip], object]:
    return lambda clip: clip.images.__setitem__(frame, make(clip.images[frame]))


def one_frame(clip: StoredClip) -> None:
    clip.timestamps, clip.rows, clip.images = clip.timestamps[:1], clip.rows[:1], clip.images[:1]


def columns(number: int, change_columns: Callable[[list[str]], list[str]]) -> Damage:
    """Change the columns of a frame's line."""

    def damage(folder: Path) -> None:
        lines = (folder / "train/bad.txt").read_text().splitlines()
        lines[1 + number] = " ".join(change_columns(lines[1 + number].split()))
        (folder / "train/bad.txt").write_text("\n".join(lines))

    return damage


def chunk(make: Callable[[dict], object]) -> Damage:
    return lambda folder: torch.save(make(chunk_entry(CLIPS[0])), folder / "train/000000.torch")


def entry(**fields: object) -> Damage:
    return chunk(lambda whole: [whole | fields])


def linked_chunk(folder: Path) -> None:
    shutil.copy(folder / "train/000000.torch", folder / "0.torch")
    (folder / "train/link.torch").symlink_to("../0.torch")
    put("train/index.json", "d", "link.torch")(folder)


def store(folder: Path) -> Path:
    return next(folder.rglob("manifest.json")).parent


def in_store(damage: Damage) -> Damage:
    return lambda folder: damage(store(folder))


def signed(keys: str, value: object) -> Damage:
    """Change a manifest, and its checksum accordingly."""

    def damage(folder: Path) -> None:
        both(put("manifest.json", keys, value), put("manifest.json", "sha256", "0" * 64))(folder)
        text = (folder / "manifest.json").read_text()
        digest = hashlib.sha256(text.encode()).hexdigest()
        (folder / "manifest.json").write_text(text.replace("0" * 64, digest))

    return in_store(damage)


def zeros(folder: Path) -> None:
    path = folder / "latents.arrow"
    path.write_bytes(bytes(path.stat().st_size))


def fewer_columns(folder: Path) -> None:
    path = folder / "latents.arrow"
    size, table = path.stat().st_size, pa.ipc.open_stream(path.read_bytes()).read_all().select(["name", "mean"])
    with pa.ipc.new_stream(path, table.schema) as writer:
        writer.write_table(table)
    path.write_bytes(path.read_bytes().ljust(size, b"\0"))


def tensors(change_tensors: Callable[[dict], object]) -> Damage:
    return lambda folder: rewrite(folder, change_tensors)


def published(**settings: object) -> Damage:
    return lambda folder: write_published(folder, "hydrants", settings=settings)


def textured(texture: str, library: str = "a.mtl", pipe: bool = False, link: bool = False, form: str = "obj") -> Damage:
    """Write a triangle whose texture is a file, perhaps a pipe or a link to a private file."""

    def damage(folder: Path) -> None:
        folder = folder / "meshes/sub"
        if pipe:
            os.mkfifo(folder / "t.png")
        if link:
            (folder / "t.png").symlink_to(folder / "../../outside/private.png")
        if form == "obj":
            meshes.write_textured(folder, texture, library)
            return
        path = meshes.write_gltf(folder / "a.gltf", texture)
        if form == "glb":
            text = path.read_bytes()
            text += b" " * (-len(text) % 4)
            sizes = b"".join(size.to_bytes(4, "little") for size in (2, 20 + len(text), len(text)))
            path.with_suffix(".glb").write_bytes(b"glTF" + sizes + b"JSON" + text)
            path.unlink()

    return damage


def ply(*lines: str, form: str = "ascii", data: str = "1 2 3\n") -> Damage:
    return content("a.ply", "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", data]).encode())


class Refused(NamedTuple):
    """A kind of damage, and the one line with which it is refused.

    Attributes:
        place: file in the input's folder, sequence and frame, with which the line begins.
        reason: part of the rest.
        gone: frames of the damaged sequence that are not usable; those of others all are. None: not known to the row.
        others: how many refusals follow.
    """

    damage: Damage
    kind: type[CompleteSplatError]
    place: str
    reason: str
    gone: list[int] | None = None
    others: int = 0


F, S, L = (f"{CATEGORY}/{name}" for name in (FRAMES, SEQUENCES, SET_LIST))
IMAGE, MASK, DEPTH = (f"{CATEGORY}/a/{part}/frame000002.png" for part in ("images", "masks", "depths"))
CLOUD, ALL = f"{CATEGORY}/a/pointcloud.ply", [0, 1, 2, 3]
F2 = f"{F}, a, frame 2"
NO_CLOUD = put(S, "0.point_cloud", None)
CO3D = [
    (put(F, "2.viewpoint", ...), BadAnnotation, F2, "no viewpoint", [2]),
    (put(F, "2.viewpoint.R", ...), BadAnnotation, F2, "R must be 3 x 3 numbers", [2]),
    (put(F, "2.viewpoint.R", turned(0.3, 1.001)), BadCamera, F2, "R is not orthonormal", [2]),
    (put(F, "2.viewpoint.R", turned(0.3, -1.0)), BadCamera, F2, "R is a reflection", [2]),
    (put(F, "2.viewpoint.R", turned(0.3, NAN)), BadAnnotation, F2, "R is not finite", [2]),
    (put(F, "2.viewpoint.T", [0.0, 1e200, 4.0]), BadAnnotation, F2, "T is not finite in float32", [2]),
    (put(F, "2.viewpoint.focal_length", [0, 2]), BadCamera, F2, "focal_length must be positive", [2]),
    (put(F, "2.viewpoint.principal_point", [0, 1.2]), BadCamera, F2, "lies outside of the 32 x 24 image", [2]),
    (put(F, "2.viewpoint.intrinsics_format", "screen"), BadAnnotation, F2, "unknown intrinsics format 'screen'", [2]),
    (put(F, "2.image.size", [0, 32]), BadAnnotation, F2, "two positive integers", [2]),
    (put(F, "2.image.size", [10**400, 24]), BadAnnotation, F2, "two positive integers", [2]),
    (put(F, "2.mask", None), BadAnnotation, F2, "mask must be of type dict", [2]),
    (put(F, "2.depth.scale_adjustment", NAN), BadAnnotation, F2, "scale_adjustment is not finite", [2]),
    (put(F, "2.image.path", 7), BadAnnotation, F2, "path must be of type str", [2]),
    (put(F, "2.image.path", "things/../../x.jpg"), OutsidePath, F2, "outside", [2]),
    (put(F, "2.image.path", "things/\ud800.jpg"), OutsidePath, F2, "no file name has", [2]),
    (edit(F, lambda e: [None, *e]), BadAnnotation, F, "entry 0: no sequence_name", []),
    (put(F, "2.frame_number", ...), BadAnnotation, f"{F}, a", "no frame_number", [2]),
    # It is not known whose entry this was: its frame is missing, too.
    (put(F, "2.sequence_name", 0), BadAnnotation, F, "entry 2: seq", [2], 1),
    (edit(F, lambda e: e.append(e[2])), BadAnnotation, F2, "annotated twice", []),
    (edit(S, lambda e: e.append(e[0])), BadAnnotation, f"{S}, a", "annotated twice", []),
    (put(S, "0.point_cloud.path", "../x"), OutsidePath, f"{S}, a", "outside", ALL),
    (put(S, "0.viewpoint_quality_score", "1"), BadAnnotation, f"{S}, a", "must be a number", ALL),
    (edit(S, lambda e: e[1:]), BadAnnotation, f"{S}, a", "not annotated", ALL),
    (edit(F, lambda e: {"frames": e}), BadAnnotation, F, "must hold a list"),
    (edit(L, lambda s: [s]), BadAnnotation, L, "no train"),
    (edit(L, lambda s: s["train"].append(["a"])), BadAnnotation, L, "expected", []),
    (edit(L, lambda s: s["train"].append(["a", 99])), BadAnnotation, f"{L}, a, frame 99", "not annotated", []),
    *((cut(file, 100), UnreadableFile, file, "") for file in (F, S, L)),
    *((gone(file), MissingFile, file, "no such file") for file in (F, S)),
    (gone(L), DataError, f"{CATEGORY}/set_lists", "no set list 'fewview_dev'"),
    (moved_outside, OutsidePath, f"{F}, a, frame 0", "leads outside", ALL, 3),
    (black(IMAGE, "RGB"), BadImage, f"{IMAGE}, a, frame 1", "", [1]),
    (black(MASK, "L"), BadImage, f"{MASK}, a, frame 1", "", [1]),
    (content(IMAGE, b"image"), BadImage, f"{IMAGE}, a, frame 1", "", [1]),
    (gone(MASK), MissingFile, f"{MASK}, a, frame 1", "no such file", [1]),
    (replaced(IMAGE, os.mkfifo), MissingFile, f"{IMAGE}, a, frame 1", "no such file", [1]),
    (gone(CLOUD), MissingFile, f"{CLOUD}, a", "no such file", ALL),
    (both(NO_CLOUD, gone(DEPTH)), MissingFile, f"{DEPTH}, a, frame 1", "no such file", ALL),
    (both(NO_CLOUD, put(F, "1.depth.scale_adjustment", 0)), BadImage, f"{DEPTH}, a, frame 1", "", ALL),
    (both(NO_CLOUD, unknown_depth), BadPlacement, "a", "", ALL),
]  # fmt: skip
HTML = b"<html>404</html>"
OTHER_SIZE = make_clip("x", size=(32, 18)).images[0]
# Changes of a clip in whichever form it is stored: (change, kind, frame, reason).
CLIP = [
    (row(2, 9, np.nan), BadAnnotation, 2, "not finite"),
    (row(2, 9, 1e30), BadAnnotation, 2, "not finite in float32"),
    (lambda clip: row(2, slice(6, 10), -clip.rows[2, 6:10])(clip), BadCamera, 2, ""),
    (row(2, 6, 1.01), BadCamera, 2, "not a rotation and translation"),
    (row(3, 1, 0), BadCamera, 3, ""),
    (row(2, 4, 0.1), BadCamera, 2, ""),
    (one_frame, TooFewFrames, None, ""),
    (image(2, lambda data: data[: len(data) // 2]), BadImage, 2, ""),
    (image(0, lambda _: HTML), BadImage, 0, ""),
    (image(2, lambda _: OTHER_SIZE), BadImage, 2, ""),
]
T, C = "train/bad.txt", "train/000000.torch"


def place_in(form: str, kind: type[DataError], frame: int | None) -> str:
    """Return a fault's file, clip and frame; only the text form has a file for each image."""
    file = f"train/bad/{33_000 * (frame + 1)}.jpg" if form == "text" and kind is BadImage else {"text": T}.get(form, C)
    return f"{file}, bad" if frame is None else f"{file}, bad, frame {frame}"


TEXTS = [(stored(edit, write_texts), kind, place_in("text", kind, frame), why) for edit, kind, frame, why in CLIP]
TEXTS += [
    (content(T, CLIPS[0].images[0]), UnreadableFile, f"{T}, bad", ""),
    (replaced(T, Path.mkdir), MissingFile, f"{T}, bad", ""),
    (columns(1, lambda line: [*line, "0"]), BadAnnotation, f"{T}, bad, frame 1", ""),
    (columns(2, lambda line: [*line[:5], "k1", *line[6:]]), BadAnnotation, f"{T}, bad, frame 2", ""),
    (columns(2, lambda line: ["66000", *line[1:]]), BadAnnotation, f"{T}, bad, frame 1", ""),
    (columns(2, lambda line: ["98999", *line[1:]]), MissingFile, "train/bad/98999.jpg, bad, frame 2", ""),
]  # fmt: skip
INDEX = "train/index.json"
LARGE = torch.zeros(1, dtype=torch.uint8).expand(10**6)
CHUNKS = [(stored(edit, write_chunks), kind, place_in("chunk", kind, frame), why) for edit, kind, frame, why in CLIP]
CHUNKS += [
    (entry(cameras=torch.zeros(4, 17)), BadAnnotation, f"{C}, bad", "18 columns"),
    (entry(cameras=torch.zeros(3, 18)), BadAnnotation, f"{C}, bad", "4 images, 3 cameras and 4 timestamps"),
    (entry(timestamps=torch.arange(4.0)), BadAnnotation, f"{C}, bad", "timestamps are not int64"),
    (entry(timestamps=torch.tensor([0, 1, 2, 1])), BadAnnotation, f"{C}, bad, frame 1", "another frame has its time"),
    (entry(images=[LARGE] * 4), BadAnnotation, f"{C}, bad", "images are not a list"),
    (cut(C, -500), UnreadableFile, f"{C}, bad", ""),
    (chunk(lambda whole: list(whole["images"])), BadAnnotation, f"{C}, bad", ""),
    (chunk(lambda whole: [whole, whole]), BadAnnotation, f"{C}, bad", ""),
    (chunk(lambda whole: [whole | {"key": "other"}]), BadAnnotation, f"{C}, bad", ""),
    (put(INDEX, "b", "../0.torch"), OutsidePath, f"{INDEX}, b", "leads outside"),
    (put(INDEX, "c", "/0.torch"), OutsidePath, f"{INDEX}, c", "another machine"),
    (linked_chunk, OutsidePath, f"{INDEX}, d", "links may not leave it"),
    (put(INDEX, "e", ""), OutsidePath, f"{INDEX}, e", "leads outside of train, or nowhere"),
]  # fmt: skip
J = "transforms.json"
TRANSFORMS = [
    *(
        (content(J, text), BadAnnotation, f"{J}, input", "no frames in")
        for text in (b"null", b"[]", b"7", b'"frames"', b"{}")
    ),
    (edit(J, lambda c: c["frames"].__delitem__(slice(5, None))), TooFewFrames, f"{J}, input", "at least 6"),
    (put(J, "frames.3.transform_matrix.0.3", NAN), BadAnnotation, f"{J}, input, frame 3", "not finite"),
    *(
        (put(J, "frames.5.transform_matrix.0.3", x), BadAnnotation, f"{J}, input, frame 5", "not finite in float32: ")
        for x in (1e200, -1e300, 1e25)
    ),
    (put(J, "frames.3.transform_matrix.0.0", 0.3), BadCamera, f"{J}, input, frame 3", "not orthonormal"),
    (put(J, "frames.3.transform_matrix.3.0", 0.1), BadCamera, f"{J}, input, frame 3", "matrix ends in the row"),
    (put(J, "frames.2.file_path", "./frame1"), BadAnnotation, f"{J}, input, frame 2", "the same image as frame 1"),
    (put(J, "frames.2.file_path", "../frame2.png"), OutsidePath, f"{J}, input, frame 2", "leads outside"),
    (put(J, "frames.4.mask_path", "m.png"), MissingFile, "m.png, input, frame 4", "no such file"),
    (put(J, "fl_x", ...), BadAnnotation, f"{J}, input, frame 0", "neither fl_x nor camera_angle_x"),
    (put(J, "frames.1.fl_y", -2.0), BadCamera, f"{J}, input, frame 1", "must be positive"),
    (both(put(J, "fl_x", ...), put(J, "camera_angle_x", 3.2)), BadCamera, f"{J}, input, frame 0", "view of 3.2"),
    (put(J, "frames.1.cx", 16.0), BadCamera, f"{J}, input, frame 1", "principal point (16, 6) lies outside"),
    (put(J, "camera_model", "OPENCV_FISHEYE"), BadCamera, f"{J}, input, frame 0", "OPENCV_FISHEYE is not supported"),
    (put(J, "is_fisheye", True), BadCamera, f"{J}, input, frame 0", "is_fisheye is not supported"),
    (put(J, "k4", 0.1), BadCamera, f"{J}, input, frame 0", "k4 = 0.1 has no meaning for camera model OPENCV"),
    (put(J, "ply_file_path", J), UnreadableFile, f"{J}, input", "not a point cloud"),
]  # fmt: skip
COLMAP = [
    (damage(f"sparse/0/{name}.bin"), DataError, f"sparse/0/{name}.bin, input", "cut off")
    for name in ("cameras", "images", "points3D")
    for damage in (longer, partial(cut, size=1), partial(cut, size=-1))
]
M, CHECKSUM = "manifest.json", "its checksum is another"
LATENTS = [
    (in_store(cut("latents.arrow", -1)), ChangedFile, "latents.arrow", "another size"),
    (in_store(longer("latents.arrow")), ChangedFile, "latents.arrow", "another size"),
    (in_store(zeros), UnreadableFile, "latents.arrow", "damaged"),
    (in_store(gone("latents.arrow")), MissingFile, "latents.arrow", "no such file"),
    (in_store(fewer_columns), ChangedFile, "latents.arrow", "not what the manifest describes"),
    (in_store(cut(M, -20)), DataError, M, "not a JSON file"),
    (in_store(put(M, "std.0", 7.5)), ChangedFile, M, CHECKSUM),
    (signed("format", 99), DataError, M, ""),
    (signed("shapes.mean", [4, 2]), DataError, "latents.arrow, c0", "damaged"),
    (signed("origin.precision", "object"), DataError, M, ""),
    (signed("bytes", 3), DataError, "latents.arrow", ""),
    (signed("origin.frames", "all"), DataError, M, ""),
]  # fmt: skip
DAMAGED = "damaged, or not a VAE"
RESHAPED = {kind: torch.ones(8).to(kind) for kind in (torch.int64, torch.complex64, torch.bool)}
EXTRA, MISSING = "decoder.extra", "decoder.mid_block.resnets.1.conv2.bias"
VAES = [
    (put("config.json", "act_fn", "gelu"), "its activation is gelu, not silu"),
    (tensors(lambda t: t.update({EXTRA: torch.zeros(1)})), f"{EXTRA} has no place here"),
    (tensors(lambda t: t.pop(MISSING)), f"{MISSING} is missing there"),
    *((cut(SAFETENSORS, size), "damaged") for size in (-1, 0)),
    *((content("config.json", text), DAMAGED) for text in (b"", b"[1]")),
    (tensors(lambda t: t["encoder.conv_in.bias"].fill_(NAN)), "encoder.conv_in.bias is not finite; fetch it again"),
    *(
        (tensors(lambda t, x=x: t.update({"encoder.conv_in.bias": x})), f"bias is [8] of {kind} there and [8] here")
        for kind, x in RESHAPED.items()
    ),
    (both(gone(SAFETENSORS), lambda f: torch.save({"weights": VAE.state_dict()}, f / BIN)), "is missing there"),
    (gone("config.json"), f"give autoreconstructor.pretrained={SAFETENSORS}"),
    (gone(SAFETENSORS), "hf download"),
    (lambda f: (f / SAFETENSORS).rename(f / "a.safetensors"), "the VAE, give autoreconstructor.pretrained=a.safe"),
]  # fmt: skip
Y, P = "config_hydrants.yaml", "model_hydrants.pth"
PUBLISHED = [
    (published(model={"base_dim": 10**6}), WeightsError, Y, "model.base_dim is 1000000"),
    (published(data={"training_resolution": None}), WeightsError, Y, "data.training_resolution is None"),
    (content(Y, b"model: !!python/object/apply:pathlib.Path.touch [called]"), WeightsError, Y, "not readable as YAML"),
    (content(Y, b"a: &a [1, 2]\nb: [*a, *a]"), WeightsError, Y, "has aliases"),
    (content(Y, b"just text"), WeightsError, Y, "data.training_resolution is None"),
    (gone(Y), WeightsError, P, f"{Y} is missing beside it"),
    (gone(P), WeightsError, P, "no such file"),
    *((cut(P, size), WeightsError, P, "damaged") for size in (0, 100)),
    (lambda folder: torch.save({"state_dict": {}}, folder / P), WeightsError, P, f"no {STATE} in it"),
]  # fmt: skip
R = "reference_camera"
DEEP = b"[" * 100_000 + b"]" * 100_000
PREDICTION = [
    (put("scene.json", keys, value), CompleteSplatError, "scene.json", why)
    for keys, value, why in [
        (f"{R}.image_size", [INF, 32], "Infinity is no JSON"),
        (f"{R}.image_size", [0, 32], "image_size must be from 1 to 64,000,000 pixels, not [0, 32]"),
        (f"{R}.image_size", [32, 1e300], "image_size is not finite in float32"),
        (f"{R}.image_size", [32], "image_size must be 2 numbers"),
        (f"{R}.intrinsics", np.zeros((3, 3)).tolist(), "intrinsics of no camera"),
        (f"{R}.intrinsics.0.0", 1e-300, "intrinsics of no camera"),
        (f"{R}.intrinsics.0.2", 1e200, "intrinsics is not finite in float32"),
        (f"{R}.world_to_camera", pose(0, 3, NAN), "NaN is no JSON"),
        (f"{R}.world_to_camera", pose(0, 0, 0), "world_to_camera is not orthonormal"),
        (f"{R}.world_to_camera", pose(2, 3, 1e30), "world_to_camera is not finite in float32"),
        ("settings.up", [NAN] * 3, "NaN is no JSON"),
        ("settings.up", [0, 0, 0], "up must have a length, not [0, 0, 0]"),
        ("settings.up", [0, -1e300, 0], "up is not finite in float32"),
        ("settings.up", "north", "up must be 3 numbers, not 'north'"),
    ]
] + [(content("scene.json", DEEP), CompleteSplatError, "scene.json", "not a JSON file")]
NEWEST = [
    (put("scenes.json", f"scenes.0.{R}.intrinsics", np.zeros((3, 3)).tolist()), "intrinsics of no camera"),
    (put("scenes.json", "up", [0, INF, 0]), "Infinity is no JSON"),
    (put("scenes.json", f"scenes.0.{R}", None), f"{R} must be of type dict, not None"),
    (content("scenes.json", DEEP), "not a JSON file"),
]  # fmt: skip
XYZ = ["element vertex 1", *(f"property float {axis}" for axis in "xyz")]
PLY = [
    (ply(*XYZ, "property list uchar int more", data="1 2 3 1 1\n"), "a list in"),
    (ply(*XYZ, "property list x"), "header line not understood: 'property list x'"),
    (ply(*XYZ, form="binary_middle_endian"), "format not understood"),
    (ply(*XYZ, *XYZ), "several elements vertex"),
    (ply("element face 0"), "no element vertex"),
    (ply(*XYZ, "property float x"), "names a property twice"),
    (ply(*XYZ[:3]), "no property z"),
    (ply(*XYZ, data="1 2\n"), "column"),
    (ply(*XYZ, data="1 2 three\n"), "three"),
    (ply(*XYZ, "property uchar red", data="1 2 3 256\n"), "256"),
    (ply(*XYZ, data="1 2 é\n"), "ascii"),
    (content("a.ply", b""), "not a .ply file"),
    (content("a.ply", b"ply\n" + b"comment x\n" * 20_000), "no end of the header"),
]  # fmt: skip
LIES = "lies outside of the folder of meshes"
MESHES = [
    (textured("../../outside/private.png"), f"private.png {LIES}"),
    (textured("t.png", "../../outside/private.mtl"), f"private.mtl {LIES}"),
    (textured("t.png", link=True, form="gltf"), f"t.png {LIES}"),
    (textured("..%2F../outside/private.png", form="glb"), f"private.png {LIES}"),
    (textured("t.png", pipe=True), "t.png is no regular file"),
    (textured("t.png", pipe=True, form="gltf"), "t.png is no regular file"),
    # A place on another machine; Blender takes the file of that name beside the mesh.
    (textured("C:\\work\\t.png", pipe=True), "t.png is no regular file"),
]
TABLE: dict[str, list[tuple]] = {
    "co3d": CO3D,
    "texts": TEXTS,
    "chunks": CHUNKS,
    "transforms": TRANSFORMS,
    "colmap": COLMAP,
    "latents": LATENTS,
    "vae": [(damage, WeightsError, "DIR", reason) for damage, reason in VAES],
    "published": PUBLISHED,
    "prediction": PREDICTION,
    "newest": [(damage, CompleteSplatError, "scenes.json", reason) for damage, reason in NEWEST],
    "ply": [(damage, PlyError, "", reason) for damage, reason in PLY],
    "meshes": [(damage, DataError, "", reason) for damage, reason in MESHES],
}
ROWS = [
    pytest.param(reader, Refused(*line), id=f"{reader} {line[2]}: {line[3]}")
    for reader, lines in TABLE.items()
    for line in lines
]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Write the intact input of a reader once."""

    @cache
    def write(reader: str) -> Path:
        folder = tmp_path_factory.mktemp(reader) / "input"
        folder.mkdir()
        READERS[reader].write(folder)
        return folder

    return write


@pytest.fixture
def copied(intact: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    return lambda reader: Path(shutil.copytree(intact(reader), tmp_path / "input", symlinks=True))


@pytest.mark.parametrize("reader", sorted(TABLE.keys() - {"meshes"}))
def test_an_intact_input_is_read_whole(intact, reader):
    value = READERS[reader].read(intact(reader))
    assert not isinstance(value, Usable) or value.refused == []


@pytest.mark.parametrize(("reader", "expected"), ROWS)
def test_damage_is_refused_in_one_line_that_names_its_place(reader, expected, copied):
    folder = copied(reader)
    whole = {(name, frame) for name in ("a", "b") for frame in ALL}
    expected.damage(folder)
    try:
        result = READERS[reader].read(folder)
        refused, frames = result.refused, result.frames
    except CompleteSplatError as error:
        refused, frames = [error], None
    message = str(refused[0]).replace(f"{folder}/", "").replace(str(folder), "DIR")
    assert "\n" not in str(refused[0])
    assert message.startswith(f"{expected.place}: " if expected.place else "")
    assert expected.reason in message
    assert isinstance(refused[0], expected.kind)
    assert len(refused) == 1 + expected.others
    if reader == "co3d" and expected.gone is not None:
        assert frames == whole - {("a", frame) for frame in expected.gone}
