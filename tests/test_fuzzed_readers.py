"""Fuzzing of every reader of untrusted files: it must return or refuse, in bounded memory and time.

`make fuzz` fuzzes each reader for a given time. The tests give it a few damaged files, the same ones every time.
Files that broke a reader are added to its test as `cases`.
"""

import gzip
import io
import json
import shutil
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SUBSET
from fuzzing import (
    CLEAR,
    damaged,
    damaged_json,
    damaged_parts,
    fuzz,
    gzipped,
    json_bytes,
    png_of,
    png_parts,
    zip_of,
    zip_parts,
)
from hypothesis import strategies as st
from PIL import Image, ImageCms
from readers import READERS, put, read_frames
from splats_of_others import FILES
from support import some_gaussians

from completesplat.data.captures.captured_frames import CapturedFrame, Lens
from completesplat.data.co3d.depth_maps import read_depth
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.srn.module import read_intrinsics, read_pose
from completesplat.data.validation import read_points
from completesplat.errors import CompleteSplatError
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.reading import read_gaussians
from completesplat.export.splat import write_splat
from completesplat.generator import CompleteSplat
from completesplat.photo.exif import ORIENTATION
from completesplat.photo.files import decode_image, stored_size
from completesplat.photo.reading import Framing, read_square
from completesplat.weights import CONFIG_FILE, SUMS_FILE

measured = pytest.mark.skipif(not CLEAR.exists(), reason="memory is measured as Linux reports it")
pytestmark = [pytest.mark.processes, measured]
PIXELS = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
COMPRESSIONS = (None, "tiff_lzw", "tiff_adobe_deflate", "jpeg", "packbits")
MOST_MEMORY_OF_A_PHOTO = 2**31  # for the largest allowed photo, of 64 million pixels


def each(*reads: Any) -> None:
    """Call all readers of a file, even if some of them refuse it."""
    for read in reads:
        with suppress(CompleteSplatError):
            read()


def encoded(pixels: np.ndarray, form: str, mode: str | None = None, **options: Any) -> bytes:
    file, photo = io.BytesIO(), Image.fromarray(pixels)
    (photo if mode is None else photo.convert(mode)).save(file, form, **options)
    return file.getvalue()


def photos() -> dict[str, list[bytes]]:
    """Return small image files of all formats and most modes, by format."""
    rgb, grey, alpha = PIXELS[..., :3], PIXELS[..., 0], PIXELS[..., 3].astype(np.uint16) * 200
    record = Image.Exif()
    record[ORIENTATION] = 6
    record.get_ifd(0x8769)[0xA405] = 35
    more = {"exif": record.tobytes(), "icc_profile": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()}
    return {
        "PNG": [
            *(encoded(rgb, "PNG", mode) for mode in (None, "P", "1", "L", "LA", "RGBA")),
            *(encoded(part, "PNG") for part in (alpha, PIXELS)),
            *(encoded(rgb, "PNG", "P", transparency=3), encoded(rgb, "PNG", **more)),
            encoded(rgb, "PNG", save_all=True, append_images=[Image.fromarray(rgb[::-1])]),
        ],
        "JPEG": [encoded(rgb, "JPEG", mode) for mode in (None, "L", "CMYK")]
        + [encoded(rgb, "JPEG", progressive=True, **more)],
        "TIFF": [encoded(rgb, "TIFF", compression=kind) for kind in COMPRESSIONS]
        + [encoded(part, "TIFF") for part in (grey, alpha, grey.astype(np.float32) / 255, PIXELS)],
        "others": [
            *(encoded(rgb, form) for form in ("BMP", "GIF", "PPM", "JPEG2000", "WEBP", "AVIF", "MPO")),
            *(encoded(PIXELS, "WEBP", lossless=True, **more), encoded(grey, "BMP"), encoded(rgb, "BMP", "P")),
        ],
    }


def test_images(tmp_path):
    files, path = photos(), tmp_path / "a"

    def read_images(content: bytes) -> None:
        path.write_bytes(content)
        calls = [partial(decode_image, path, "a", mode) for mode in ("RGB", "L")]
        calls += [
            partial(stored_size, path, "a"),
            partial(read_depth, path, 1.0),
            CapturedFrame(0, path, None, Lens((9.0, 9.0), (8.0, 6.0), (12, 16)), np.eye(4)).read,
        ]
        each(*calls, partial(read_square, path, Framing(16)))

    depth = np.full((12, 16), 4.0, np.float16).view(np.uint16)
    parts = [png_parts(content) for content in (*files["PNG"], encoded(depth, "PNG"))]
    every = st.one_of(*map(damaged, files.values()), damaged_parts(parts, png_of))
    for content in (content for several in files.values() for content in several):
        read_images(content)
    fuzz(every, read_images, examples=60, most_memory=MOST_MEMORY_OF_A_PHOTO)


def test_lenses_and_poses_in_text(tmp_path):
    path = tmp_path / "a.txt"
    lens = b"131.250000 64.000000 64.000000 0.\n0. 0. 0.\n1.\n128 128\n"
    pose = b"1 0 0 0 0 -1 0 0 0 0 -1 1.3 0 0 0 1\n"

    def read_texts(content: bytes) -> None:
        path.write_bytes(content)
        each(partial(read_intrinsics, path), partial(read_pose, path))

    words = [*lens.split(), *pose.split(), b"1e309", b"-1e308", b"nan", b"0", b"\n", b"inf", b"x", b"1_0"]
    spelled = st.lists(st.sampled_from(words), max_size=24).map(b" ".join)
    fuzz(st.one_of(damaged([lens, pose]), spelled), read_texts)


HEADER = b"""ply
format ascii 1.0
comment a
element camera 1
property double focal
element vertex 2
property float x
property double y
property int z
property uchar red
element face 1
property list uchar int vertex_indices
end_header
1.5
0 1 2 3
4 5.5e3 nan -1
3 0 1 2
"""


def test_ply(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, some_gaussians(1)[0])
    splats = path.read_bytes()

    def read_plys(content: bytes) -> None:
        path.write_bytes(content)
        each(partial(read_ply, path), partial(read_points, path))

    seeds = [splats, splats.replace(b"little_endian", b"big_endian"), HEADER]
    words = st.lists(
        st.sampled_from([*HEADER.split(b"\n"), *HEADER.split(), *splats[:600].split(b"\n"), b"\n", b" ", b"\n" * 3]),
        max_size=30,
    )
    fuzz(damaged(seeds) | words.map(lambda result: b"ply\n" + b"\n".join(result)), read_plys, examples=60)


def test_splats_of_others(tmp_path):
    path = {suffix: tmp_path / f"a{suffix}" for suffix in (".splat", ".spz")}
    write_splat(path[".splat"], some_gaussians(1)[0])
    seeds = {".splat": [path[".splat"].read_bytes()], ".spz": [*FILES.values()]}

    def read_splats(changed: tuple[str, bytes]) -> None:
        path[changed[0]].write_bytes(changed[1])
        read_gaussians(path[changed[0]])

    def of(suffix: str) -> st.SearchStrategy[tuple[str, bytes]]:
        unpacked = [gzip.decompress(content) for content in seeds[suffix] if content.startswith(b"\x1f\x8b")]
        changed = damaged(seeds[suffix]) | damaged(unpacked).map(gzipped) if unpacked else damaged(seeds[suffix])
        return st.tuples(st.just(suffix), changed)

    fuzz(of(".splat") | of(".spz"), read_splats, examples=60)


FILES_OF = {
    "co3d": [f"{CATEGORY}/{name}" for name in (FRAMES, SEQUENCES, SET_LIST)],
    "chunks": ["train/index.json", "train/000000.torch"],
    "transforms": ["transforms.json"],
    "colmap": [f"sparse/0/{name}.bin" for name in ("cameras", "frames", "images", "points3D", "rigs")],
}
LENS = {"k1": 0.01, "k2": 0.0, "p1": 0, "p2": 0, "camera_model": "OPENCV", "ply_file_path": "points.ply"}


def read_annotations(folder: Path) -> None:
    """Read a category with and without lists, both for training and for testing."""
    for subset, split in product((SUBSET, None), ("train", "test")):
        with suppress(CompleteSplatError):
            data = CO3DDataModule(str(folder), CATEGORY, subset, image_size=8, batch_size=2, targets=1)
            read_frames(data.source(split))


def changed(name: str, content: bytes) -> st.SearchStrategy[bytes]:
    """Damage a file's bytes, or the content of a format and then write it rightly."""
    if name.endswith(".torch"):
        return damaged([content]) | damaged_parts([zip_parts(content)], zip_of)
    if name.endswith(".bin"):
        return damaged([content])
    packed = name.endswith(".jgz")
    value = json.loads(gzip.decompress(content) if packed else content)
    seeds = [value, {**value, **LENS}] if name == "transforms.json" else [value]
    whole = damaged_json(seeds).map(json_bytes)
    return (whole.map(gzipped) if packed else whole) | damaged([content])


def claimed(files: dict[str, bytes], name: str, place: int) -> tuple[str, bytes]:
    """Return a file whose count at `place` claims the largest possible number of entries."""
    return name, files[name][:place] + b"\xff" * 8 + files[name][place + 8 :]


@pytest.mark.parametrize("reader", FILES_OF)
def test_inputs_of_several_files(reader, tmp_path):
    READERS[reader].write(tmp_path)
    if reader == "transforms":
        write_ply(tmp_path / "points.ply", some_gaussians(1)[0])
        put("transforms.json", "frames.0.mask_path", "frame1.png")(tmp_path)
    files = {name: (tmp_path / name).read_bytes() for name in FILES_OF[reader]}
    read = read_annotations if reader == "co3d" else READERS[reader].read

    def read_files(change: tuple[str, bytes]) -> None:
        for name, content in files.items():
            (tmp_path / name).write_bytes(change[1] if change[0] == name else content)
        read(tmp_path)

    read_files(("", b""))
    cases = []
    if reader == "chunks":
        cases = [("train/index.json", json_bytes({"a": "x" * 5000}))]
    elif reader == "colmap":
        images = "sparse/0/images.bin"
        cases = [claimed(files, "sparse/0/points3D.bin", 8 + 43), *(claimed(files, name, 0) for name in files)]
        cases += [(images, files[images].replace(b"frame3", b"\x80rame3"))]
    changes = (st.tuples(st.just(name), changed(name, content)) for name, content in files.items())
    fuzz(st.one_of(*changes), read_files, cases, examples=20 if reader == "co3d" else 60)


def test_weights(tiny_weights, tmp_path):
    folder = shutil.copytree(tiny_weights, tmp_path / "weights")
    (folder / SUMS_FILE).unlink()
    text = (folder / CONFIG_FILE).read_bytes()

    def read_weights(content: bytes) -> None:
        (folder / CONFIG_FILE).write_bytes(content)
        CompleteSplat.from_pretrained(folder)

    fuzz(damaged_json([json.loads(text)]).map(json_bytes) | damaged([text]), read_weights, examples=30)
