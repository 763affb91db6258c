"""Fuzzing of every reader of untrusted files: it must return or refuse, in bounded memory and time.

`make fuzz` fuzzes each reader for a given time. The tests give it a few damaged files, the same ones every time.
Files that broke a reader are added to its test as `cases`.
"""

import copy
import gzip
import io
import json
import shutil
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, SUBSET
from co3d_trees import write_tree as write_category
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
from realestate10k_trees import make_clip, write_chunk_form
from splats_of_others import FILES
from support import some_gaussians, write_capture

from completesplat.data.captures.capture import CapturedFrame, Lens
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.images.crop import Square
from completesplat.data.images.exif import ORIENTATION
from completesplat.data.images.files import decode_image, read_depth, stored_size
from completesplat.data.images.photograph import read_photograph
from completesplat.data.realestate10k.clips import ChunkedClips
from completesplat.data.validation import read_points
from completesplat.errors import CompleteSplatError
from completesplat.export.formats import write_splat
from completesplat.export.ply import read_ply, write_ply
from completesplat.export.reading import read_gaussians
from completesplat.generator import CompleteSplat
from completesplat.weights import CONFIG_FILE, SUMS_FILE

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(not CLEAR.exists(), reason="memory is measured as Linux reports it"),
]
PIXELS = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
COMPRESSIONS = (None, "tiff_lzw", "tiff_adobe_deflate", "jpeg", "packbits")
MOST_MEMORY_OF_A_PHOTO = 2**31  # for the largest allowed photo, of 50 million pixels


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
        each(*calls, partial(read_photograph, path, 16))

    depth = np.full((12, 16), 4.0, np.float16).view(np.uint16)
    parts = [png_parts(content) for content in (*files["PNG"], encoded(depth, "PNG"))]
    every = st.one_of(*map(damaged, files.values()), damaged_parts(parts, png_of))
    for content in (content for several in files.values() for content in several):
        read_images(content)
    fuzz(every, read_images, examples=60, most_memory=MOST_MEMORY_OF_A_PHOTO)


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


def test_annotations(tmp_path):
    category = write_category(tmp_path, {"a": 3, "b": 2, "c": 2}, {"train": ["a"], "val": ["b"], "test": ["c"]})
    files = {name: (category / name).read_bytes() for name in (FRAMES, SEQUENCES, SET_LIST)}
    packed = {name: name.endswith(".jgz") for name in files}
    contents = {
        name: json.loads(gzip.decompress(content) if packed[name] else content) for name, content in files.items()
    }

    def read_annotations(changed: tuple[str, bytes]) -> None:
        for name, content in files.items():
            (category / name).write_bytes(changed[1] if changed[0] == name else content)
        for subset in (SUBSET, None):
            data = CO3DDataModule(str(tmp_path), CATEGORY, subset, image_size=8, batch_size=2, targets=1)
            for split in ("train", "test"):
                with suppress(CompleteSplatError):
                    source = data.source(split)
                    for name in source.names:
                        each(partial(source.read, name))
                        each(lambda name=name, source=source: source.read(name).read(0))

    def of(name: str) -> st.SearchStrategy[tuple[str, bytes]]:
        whole = damaged_json([contents[name]]).map(json_bytes)
        changed = (whole.map(gzipped) if packed[name] else whole) | damaged([files[name]])
        return st.tuples(st.just(name), changed)

    huge = copy.deepcopy(contents[FRAMES])
    huge[0]["image"]["size"] = [10**400, 24]
    cases = [(FRAMES, gzipped(json_bytes(huge)))]
    fuzz(st.one_of(*map(of, files)), read_annotations, cases, examples=20)


def test_chunks(tmp_path):
    write_chunk_form(tmp_path, [make_clip("a", frames=3), make_clip("b", frames=2)])
    index, chunk = tmp_path / "index.json", tmp_path / "000000.torch"
    table, stored = json.loads(index.read_text()), chunk.read_bytes()

    def read_chunks(changed: tuple[bytes, bytes]) -> None:
        index.write_bytes(changed[0])
        chunk.write_bytes(changed[1])
        clips = ChunkedClips(tmp_path)
        for key in clips.keys:
            with suppress(CompleteSplatError):
                clip = clips.clip(key)
                clip.read(0, Square(0, 0, 18), 8)

    whole = st.just(json_bytes(table))
    chunks = damaged([stored]) | damaged_parts([zip_parts(stored)], zip_of)
    indices = (damaged_json([table]).map(json_bytes) | damaged([json_bytes(table)])).map(lambda text: (text, stored))
    cases = [(json_bytes({"a": "x" * 5000}), stored)]
    fuzz(st.tuples(whole, chunks) | indices, read_chunks, cases, examples=60)


def test_weights(tiny_weights, tmp_path):
    folder = shutil.copytree(tiny_weights, tmp_path / "weights")
    (folder / SUMS_FILE).unlink()
    text = (folder / CONFIG_FILE).read_bytes()

    def read_weights(content: bytes) -> None:
        (folder / CONFIG_FILE).write_bytes(content)
        CompleteSplat.from_pretrained(folder)

    fuzz(damaged_json([json.loads(text)]).map(json_bytes) | damaged([text]), read_weights, examples=30)


def read_all(capture) -> None:
    """Read every frame of a capture."""
    source = CaptureDataModule(str(capture), image_size=8).source("train")
    for name in source.names:
        sequence = source.read(name)
        for index in range(len(sequence.frames)):
            sequence.read(index)


def test_transforms(tmp_path):
    capture = tmp_path / "capture"
    write_capture(capture, 6)
    path = capture / "transforms.json"
    write_ply(capture / "points.ply", some_gaussians(1)[0])
    content = json.loads(path.read_text())
    lens = {"fl_x": 20.0, "fl_y": 21.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12, "k1": 0.01, "k2": 0.0, "p1": 0, "p2": 0}
    lens |= {"camera_model": "OPENCV", "ply_file_path": "points.ply"}
    content["frames"][0] |= {"mask_path": "frame1.png", "k3": 0.001}

    def read_transforms(changed: bytes) -> None:
        path.write_bytes(changed)
        read_all(capture)

    fuzz(damaged_json([content, content | lens]).map(json_bytes) | damaged([json_bytes(content)]), read_transforms)


def test_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_capture(tmp_path / "images", 6)
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 20.0, 16, 12)
    reconstruction.add_camera_with_trivial_rig(camera)
    for number in range(6):
        image = pycolmap.Image()
        image.name, image.camera_id, image.image_id = f"frame{number}.png", 1, number + 1
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), [0, 0, number]))
    for number in range(3):
        reconstruction.add_point3D(np.full(3, float(number)), pycolmap.Track(), np.full(3, 9, dtype=np.uint8))
    reconstruction.write_binary(str(model))
    files = {path.name: path.read_bytes() for path in model.iterdir()}

    def read_models(changed: tuple[str, bytes]) -> None:
        for name, content in files.items():
            (model / name).write_bytes(changed[1] if changed[0] == name else content)
        read_all(tmp_path)

    def claimed(name: str, place: int, size: int) -> tuple[str, bytes]:
        """Return a file whose count of `size` bytes at `place` claims the largest possible number of entries."""
        return name, files[name][:place] + b"\xff" * size + files[name][place + size :]

    read_models(("", b""))
    tracks, records = claimed("points3D.bin", 8 + 43, 8), [claimed(name, 0, 8) for name in files]
    cases = [tracks, *records]
    cases += [("images.bin", files["images.bin"].replace(b"frame3", b"\x80rame3"))]
    changed = st.sampled_from(sorted(files)).flatmap(lambda name: st.tuples(st.just(name), damaged([files[name]])))
    fuzz(changed, read_models, cases)
