"""Damaged weights, scenes and splats, each kind of damage for each reader: one line names the file and the reason."""

import gzip
import math
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from damages import Refused, content, cut, gone, intact, must_read_whole, must_refuse, rows
from pretrained_vaes import BIN, SAFETENSORS, rewrite
from published_weights import write_published
from readers import VAE, Damage, put
from splats_of_others import COMPRESSED, FILES, spz_with_axes

from completesplat.baselines.splatter_image.model import STATE
from completesplat.errors import CompleteSplatError, PlyError, WeightsError
from completesplat.export.splat import RECORD

NAN = float("nan")
INF = float("inf")
NO_CAMERA = np.zeros((3, 3)).tolist()
DEEP = b"[" * 100_000 + b"]" * 100_000


# A pretrained VAE.


def tensors(**values: torch.Tensor) -> Damage:
    """Set tensors of the file; dots of their names are written as `__`."""
    named = {name.replace("__", "."): value for name, value in values.items()}
    return lambda folder: rewrite(folder, lambda stored: stored.update(named))


def without_bias(folder: Path) -> None:
    rewrite(folder, lambda stored: stored.pop("decoder.mid_block.resnets.1.conv2.bias"))


def not_finite(folder: Path) -> None:
    rewrite(folder, lambda stored: stored["encoder.conv_in.bias"].fill_(NAN))


def nested(folder: Path) -> None:
    (folder / SAFETENSORS).unlink()
    torch.save({"weights": VAE.state_dict()}, folder / BIN)


def other_name(folder: Path) -> None:
    (folder / SAFETENSORS).rename(folder / "a.safetensors")


def of_type(kind: torch.dtype) -> Refused:
    reason = f"bias is [8] of {kind} there and [8] here"
    return Refused(tensors(encoder__conv_in__bias=torch.ones(8).to(kind)), WeightsError, "DIR", reason)


EXTRA = tensors(decoder__extra=torch.zeros(1))
GIVE = "give autoreconstructor.pretrained="
VAES = [
    Refused(put("config.json", "act_fn", "gelu"), WeightsError, "DIR", "its activation is gelu, not silu"),
    Refused(EXTRA, WeightsError, "DIR", "decoder.extra has no place here"),
    Refused(without_bias, WeightsError, "DIR", "decoder.mid_block.resnets.1.conv2.bias is missing there"),
    Refused(cut(SAFETENSORS, -1), WeightsError, "DIR", "damaged"),
    Refused(cut(SAFETENSORS, 0), WeightsError, "DIR", "damaged"),
    Refused(content("config.json", b""), WeightsError, "DIR", "damaged, or not a VAE"),
    Refused(content("config.json", b"[1]"), WeightsError, "DIR", "damaged, or not a VAE"),
    Refused(not_finite, WeightsError, "DIR", "encoder.conv_in.bias is not finite; fetch it again"),
    of_type(torch.int64),
    of_type(torch.complex64),
    of_type(torch.bool),
    Refused(nested, WeightsError, "DIR", "is missing there"),
    Refused(gone("config.json"), WeightsError, "DIR", f"{GIVE}{SAFETENSORS}"),
    Refused(gone(SAFETENSORS), WeightsError, "DIR", "hf download"),
    Refused(other_name, WeightsError, "DIR", f"the VAE, {GIVE}a.safe"),
]


# Published weights of Splatter Image.


def published(**settings: object) -> Damage:
    return lambda folder: write_published(folder, "hydrants", settings=settings)


def no_state(folder: Path) -> None:
    torch.save({"state_dict": {}}, folder / P)


Y = "config_hydrants.yaml"
P = "model_hydrants.pth"
CALL = b"model: !!python/object/apply:pathlib.Path.touch [called]"
PUBLISHED = [
    Refused(published(model={"base_dim": 10**6}), WeightsError, Y, "model.base_dim is 1000000"),
    Refused(published(data={"training_resolution": None}), WeightsError, Y, "data.training_resolution is None"),
    Refused(content(Y, CALL), WeightsError, Y, "not readable as YAML"),
    Refused(content(Y, b"a: &a [1, 2]\nb: [*a, *a]"), WeightsError, Y, "has aliases"),
    Refused(content(Y, b"just text"), WeightsError, Y, "data.training_resolution is None"),
    Refused(gone(Y), WeightsError, P, f"{Y} is missing beside it"),
    Refused(gone(P), WeightsError, P, "no such file"),
    Refused(cut(P, 0), WeightsError, P, "damaged"),
    Refused(cut(P, 100), WeightsError, P, "damaged"),
    Refused(no_state, WeightsError, P, f"no {STATE} in it"),
]


# Descriptions of scenes: of a prediction (scene.json), and of a run's newest samples (scenes.json).


def pose(row: int, column: int, value: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix.tolist()


def scene(keys: str, value: object, reason: str) -> Refused:
    return Refused(put("scene.json", keys, value), CompleteSplatError, "scene.json", reason)


def newest(keys: str, value: object, reason: str) -> Refused:
    return Refused(put("scenes.json", keys, value), CompleteSplatError, "scenes.json", reason)


R = "reference_camera"
PREDICTION = [
    scene(f"{R}.image_size", [INF, 32], "Infinity is no JSON"),
    scene(f"{R}.image_size", [0, 32], "image_size must be from 1 to 64,000,000 pixels, not [0, 32]"),
    scene(f"{R}.image_size", [32, 1e300], "image_size is not finite in float32"),
    scene(f"{R}.image_size", [32], "image_size must be 2 numbers"),
    scene(f"{R}.intrinsics", NO_CAMERA, "intrinsics of no camera"),
    scene(f"{R}.intrinsics.0.0", 1e-300, "intrinsics of no camera"),
    scene(f"{R}.intrinsics.0.2", 1e200, "intrinsics is not finite in float32"),
    scene(f"{R}.world_to_camera", pose(0, 3, NAN), "NaN is no JSON"),
    scene(f"{R}.world_to_camera", pose(0, 0, 0), "world_to_camera is not orthonormal"),
    scene(f"{R}.world_to_camera", pose(2, 3, 1e30), "world_to_camera is not finite in float32"),
    scene("settings.up", [NAN] * 3, "NaN is no JSON"),
    scene("settings.up", [0, 0, 0], "up must have a length, not [0, 0, 0]"),
    scene("settings.up", [0, -1e300, 0], "up is not finite in float32"),
    scene("settings.up", "north", "up must be 3 numbers, not 'north'"),
    Refused(content("scene.json", DEEP), CompleteSplatError, "scene.json", "not a JSON file"),
]
NEWEST = [
    newest(f"scenes.0.{R}.intrinsics", NO_CAMERA, "intrinsics of no camera"),
    newest("up", [0, INF, 0], "Infinity is no JSON"),
    newest(f"scenes.0.{R}", None, f"{R} must be of type dict, not None"),
    Refused(content("scenes.json", DEEP), CompleteSplatError, "scenes.json", "not a JSON file"),
]


# Vertices of PLY files.


def ply(*lines: str, form: str = "ascii", data: str = "1 2 3\n") -> Damage:
    return content("a.ply", "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", data]).encode())


XYZ = ["element vertex 1", "property float x", "property float y", "property float z"]
ENDLESS = content("a.ply", b"ply\n" + b"comment x\n" * 20_000)
LIST = ply(*XYZ, "property list uchar int more", data="1 2 3 1 1\n")
PLY = [
    Refused(LIST, PlyError, "", "a list in"),
    Refused(ply(*XYZ, "property list x"), PlyError, "", "header line not understood: 'property list x'"),
    Refused(ply(*XYZ, form="binary_middle_endian"), PlyError, "", "format not understood"),
    Refused(ply(*XYZ, *XYZ), PlyError, "", "several elements vertex"),
    Refused(ply("element face 0"), PlyError, "", "no element vertex"),
    Refused(ply(*XYZ, "property float x"), PlyError, "", "names a property twice"),
    Refused(ply(*XYZ[:3]), PlyError, "", "no property z"),
    Refused(ply(*XYZ, data="1 2\n"), PlyError, "", "column"),
    Refused(ply(*XYZ, data="1 2 three\n"), PlyError, "", "three"),
    Refused(ply(*XYZ, "property uchar red", data="1 2 3 256\n"), PlyError, "", "256"),
    Refused(ply(*XYZ, data="1 2 é\n"), PlyError, "", "ascii"),
    Refused(content("a.ply", b""), PlyError, "", "not a .ply file"),
    Refused(ENDLESS, PlyError, "", "no end of the header"),
]


# Gaussians of other programs.


def spz(version: int = 3, count: int = 1, body: bytes = bytes(20), degree: int = 0) -> bytes:
    """Return a file with a header that may say what is not so."""
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0) + body, mtime=0)


def far(factor: float) -> bytes:
    """Return 50 Gaussians as `.splat`, `factor` away from the origin."""
    records = np.zeros(50, RECORD)
    records["means"] = factor * np.random.default_rng(0).normal(size=(50, 3))
    records["scales"] = 0.1
    records["colors"] = 200
    records["quaternions"] = 200
    return records.tobytes()


def alone(name: str, data: bytes) -> Damage:
    """Replace the folder by one with this file."""

    def damage(folder: Path) -> None:
        shutil.rmtree(folder)
        folder.mkdir()
        (folder / name).write_bytes(data)

    return damage


def without_rotations(folder: Path) -> None:
    path = folder / "a.ply"
    path.write_bytes(path.read_bytes().replace(b"property float rot_3\n", b"property float rot_9\n"))


V4 = FILES["v4.spz"]
NOT_A_NUMBER = struct.pack("<6f8B", math.nan, *[0] * 13)
MORE_GAUSSIANS = V4[:8] + b"\4" + V4[9:]
NEGATIVE_STREAM = V4[:32] + b"\xff" * 8 + V4[40:]
OTHER_LENGTH = V4[:15] + b"\xff" + V4[16:]
UNPACKS = "x.ply` unpacks it, or install splat-transform"
PACKED_PLY = f"SuperSplat's compressed PLY; `splat-transform a.ply {UNPACKS}"
SPLATS = [
    Refused(alone("a.splat", bytes(33)), PlyError, "a.splat", ""),
    Refused(alone("a.splat", NOT_A_NUMBER), PlyError, "a.splat", ""),
    # Farther than renderers can square.
    Refused(alone("a.splat", far(1e20)), CompleteSplatError, "a.splat", "all 50 Gaussians are broken"),
    Refused(alone("a.spz", b""), PlyError, "a.spz", ""),
    Refused(alone("a.spz", b"ply\n"), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz(version=1)), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz(degree=3)), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz(degree=9, body=bytes(999))), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz(count=2)), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz(count=2**32 - 1)), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz()[:-12]), PlyError, "a.spz", ""),
    Refused(alone("a.spz", V4[:-20]), PlyError, "a.spz", ""),
    Refused(alone("a.spz", MORE_GAUSSIANS), PlyError, "a.spz", ""),
    Refused(alone("a.spz", NEGATIVE_STREAM), PlyError, "a.spz", ""),
    Refused(alone("a.spz", OTHER_LENGTH), PlyError, "a.spz", ""),
    Refused(alone("a.spz", spz_with_axes(9)), CompleteSplatError, "a.spz", "coordinate system 9"),
    Refused(alone("a.ply", b""), PlyError, "a.ply", ""),
    Refused(alone("a.ply", b"ply\n"), PlyError, "a.ply", ""),
    Refused(without_rotations, PlyError, "a.ply", ""),
    Refused(alone("a.ply", COMPRESSED), CompleteSplatError, "a.ply", PACKED_PLY),
    Refused(alone("a.sog", b"PK\3\4"), CompleteSplatError, "a.sog", f"SOG; `splat-transform a.sog {UNPACKS}"),
    Refused(alone("a.KSPLAT", b"\0\1"), CompleteSplatError, "a.KSPLAT", f"`splat-transform a.KSPLAT {UNPACKS}"),
]

TABLES = {
    "vae": VAES,
    "published": PUBLISHED,
    "prediction": PREDICTION,
    "newest": NEWEST,
    "ply": PLY,
    "splats": SPLATS,
}


@pytest.mark.parametrize("reader", TABLES)
def test_an_intact_input_is_read_whole(reader, built_once):
    must_read_whole(reader, built_once)


@pytest.mark.parametrize(("reader", "expected"), rows(TABLES))
def test_damage_is_refused_in_one_line_that_names_the_file(reader, expected, built_once, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "/usr/bin:/bin")  # without splat-transform
    must_refuse(reader, expected, intact(reader, built_once), tmp_path / "input")
