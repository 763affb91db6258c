"""Small meshes and cameras for tests of rendering."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from support import write_program

from completesplat.data.rendered.blender import find_blender
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras, invert_rigid

SQUARES = 4
"""Squares along an edge of the checker cube."""

SETTINGS = {"cameras": "turn", "fov": [36, 55], "light": "random", "floor": "random", "wall": "none", "seed": 0}
SETTINGS |= {"front": None, "hidden": "none", "factory": None, "count": 1, "max_megabytes": 500, "max_minutes": 5}
SETTINGS |= {"up": None, "workers": 1, "shard": 0, "shards": 1}
SETTINGS |= {"renderer": "blender"}
"""Settings of renders, without views, size and samples."""

CORNERS = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def write_cube(path: Path, half: float | Sequence[float] = 3.0, center: Sequence[float] = (0, 0, 0)) -> Path:
    """Write an OBJ of a cube with a checker on each face; the format's y axis points up."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = np.mgrid[:64, :64] * SQUARES // 64
    pixels = np.where(((rows + columns) % 2 == 0)[..., None], 230, 20).astype(np.uint8).repeat(3, axis=-1)
    Image.fromarray(pixels).save(path.with_suffix(".png"))
    path.with_suffix(".mtl").write_text(f"newmtl checker\nmap_Kd {path.stem}.png\n")
    vertices = ["v {:g} {:g} {:g}".format(*(np.multiply(half, corner) + center)) for corner in CORNERS]
    faces = ["f " + " ".join(f"{index + 1}/{place}" for place, index in enumerate(face, 1)) for face in FACES]
    textured = ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl checker"]
    path.write_text("\n".join([f"mtllib {path.stem}.mtl", *vertices, *textured, *faces]) + "\n")
    return path


def write_scan(folder: Path) -> Path:
    """Write an upright box, twice as high as wide, as Google Scanned Objects are stored: z points up in the OBJ."""
    path = write_cube(folder / "meshes/model.obj", half=(1, 1, 2))
    textures = folder / "materials/textures"
    textures.mkdir(parents=True)
    path.with_suffix(".png").rename(textures / "texture.png")
    path.with_suffix(".mtl").write_text("newmtl checker\nmap_Kd texture.png\n")
    return path


def write_ball(path: Path, **material: Any) -> Path:
    """Write a GLB of a grey ball with changes of its material, which is of no metal, in glTF's words."""
    import trimesh

    ball = trimesh.creation.icosphere(2)
    ball.export(path)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    description = json.loads(content[20 : 20 + length])
    metal = {"baseColorFactor": [0.5, 0.5, 0.5, 1], "metallicFactor": 0}
    description["materials"] = [{"pbrMetallicRoughness": metal | material.pop("pbr", {}), **material}]
    description["extensionsUsed"] = list(material.get("extensions", ()))
    description["meshes"][0]["primitives"][0]["material"] = 0
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + content[16:20] + text + content[20 + length :]
    path.write_bytes(content[:8] + (12 + len(chunks)).to_bytes(4, "little") + chunks)
    return path


def write_triangle(path: Path, vertices: str = "v 0 0 0\nv 1 0 0\nv 0 1 0\n", faces: str = "f 1 2 3\n") -> Path:
    path.write_text(vertices + faces)
    return path


def write_ply(path: Path, vertices: Sequence[Sequence[float]]) -> Path:
    """Write a triangle as a binary PLY."""
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{properties}{faces}end_header\n"
    content = np.array(vertices, dtype="<f4").tobytes() + bytes([3]) + np.arange(3, dtype="<i4").tobytes()
    path.write_bytes(header.encode() + content)
    return path


def write_textured(folder: Path, texture: str, library: str = "a.mtl") -> None:
    """Write the OBJ of a triangle whose material names a texture."""
    (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd -s 1 1 1 {texture}\n")
    write_triangle(folder / "a.obj", vertices=f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\n")


def write_stand_in(folder: Path) -> str:
    """Write a program that is no Blender, for meshes that are refused before it starts."""
    answer = '[ "$1" = --version ] && echo Blender 4.2.0 || echo has started; exit 1'
    return str(write_program(folder / "blender", answer))


def need_blender() -> None:
    """Skip the test if there is no Blender."""
    try:
        find_blender()
    except CompleteSplatError as reason:
        pytest.skip(str(reason))


def write_usd(path: Path, corner: str = "0 1 0") -> Path:
    """Write a triangle as text; `corner` is its third vertex."""
    points = f"point3f[] points = [(0, 0, 0), (1, 0, 0), ({corner.replace(' ', ', ')})]"
    faces = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]"
    path.write_text(f'#usda 1.0\ndef Mesh "triangle"\n{{\n{points}\n{faces}\n}}\n')
    return path


def write_gltf(path: Path, texture: str) -> Path:
    """Write a triangle whose texture is a file."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4")
    path.with_suffix(".bin").write_bytes(points.tobytes() + points[:, :2].tobytes())
    content = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "buffers": [{"byteLength": 60, "uri": path.with_suffix(".bin").name}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": texture}],
    }
    path.write_text(json.dumps(content))
    return path


def write_transforms(path: Path, cameras: Sequence[Cameras]) -> Path:
    """Write cameras as nerfstudio does: camera-to-world with OpenGL's axes."""
    frames = []
    for camera in cameras:
        matrix = invert_rigid(camera.world_to_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        (height, width), (fx, fy) = camera.image_size, camera.intrinsics.diagonal()[:2].tolist()
        lens = {"fl_x": fx, "fl_y": fy, "w": width, "h": height}
        lens |= dict(zip(("cx", "cy"), camera.intrinsics[:2, 2].tolist(), strict=True))
        frames.append(lens | {"transform_matrix": matrix.tolist()})
    path.write_text(json.dumps({"frames": frames}))
    return path
