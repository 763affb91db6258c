"""Textured triangles of mesh files, read by trimesh: upright, centred, the farthest corner at distance 1."""

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from PIL import Image, UnidentifiedImageError

from completesplat.data.rendered._placement import stray_faces
from completesplat.data.rendered.assets import BrokenMesh, gltf_description
from completesplat.errors import CompleteSplatError
from completesplat.installation import install_command
from completesplat.ply_files import LONGEST_HEADER

READABLE = (".glb", ".gltf", ".obj", ".ply")
"""Suffixes that trimesh reads with their textures; Blender reads the others."""
MOST_TEXTURE = 2048  # pixels of a texture's side; larger ones are reduced, because images are much smaller
FEWEST_TEXELS = 8  # side below which a texture is not halved any more
SMOOTH = np.cos(np.radians(25.0))  # a corner is shaded smoothly if its faces' normals differ less from their mean
SAME_PLACE = 1e-6  # of an object's size: corners that are nearer belong to one vertex
METAL = 0.5
GREY = 0.8  # linear, of faces without colour: Blender's own default
TURNS = {"y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), "z": np.eye(3)}
"""Rotations that make z point up, by the axis that points up in the file."""
UP_AXES = {".glb": "y", ".gltf": "y", ".obj": "y", ".ply": "z"}
"""Axes that point up: glTF's by its standard, the others' as most programs write them."""
WITHOUT_STANDARD = (".obj", ".ply")


@dataclass(frozen=True)
class Textures:
    """Linear RGBA of all textures in one array, each in halved copies ("mip levels")."""

    texels: UInt16[np.ndarray, " value"]
    levels: Int[np.ndarray, "texture level 3"]
    """First value, width and height of each copy; the last copy stands for those that are missing."""


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with shading normals, colours and textures, in a frame whose z points up.

    Attributes:
        corners: places, in units of the farthest corner's distance from the origin.
        colors: linear RGB that a texture's values are multiplied by.
        texture: number of each triangle's texture.
        cut: whether parts of a texture are transparent, and are left out.
        center: the former place of the origin.
        scale: factor from the file's units.
        left_out: number of stray faces that were removed.
        beyond: materials that this reader takes for plain colours, in words, or "".
    """

    corners: Float[np.ndarray, "triangle 3 3"]
    normals: Float[np.ndarray, "triangle 3 3"]
    uv: Float[np.ndarray, "triangle 3 2"]
    colors: Float[np.ndarray, "triangle 3 3"]
    texture: Int[np.ndarray, " triangle"]
    textures: Textures
    cut: bool
    center: Float[np.ndarray, " 3"]
    scale: float
    left_out: int
    beyond: str


@dataclass(frozen=True)
class _Part:
    corners: Float[np.ndarray, "triangle 3 3"]
    uv: Float[np.ndarray, "triangle 3 2"]
    colors: Float[np.ndarray, "triangle 3 3"]
    image: UInt8[np.ndarray, "height width 4"]


class TextureFiles:
    """Resolver of trimesh for the files that a mesh names: only those below a root, wherever copies have moved them.

    A name may have backslashes, another case, or the path of another machine. It is looked for at its own place, beside
    the mesh, and in the folder `materials/textures` beside the mesh's folder (Google Scanned Objects).
    """

    def __init__(self, mesh: Path, root: Path) -> None:
        self.mesh = mesh
        self.root = root
        self.refused: list[str] = []

    def __getitem__(self, name: str) -> bytes:
        """Return a file's content.

        Raises:
            FileNotFoundError: it is missing, outside of the root, or an image that cannot be decoded.
                `refused` says which.
        """
        path = self._find(name.strip().replace("\\", "/"))
        if path is None:
            self.refused.append(f"its texture {Path(name).name} is missing")
        elif not path.resolve().is_relative_to(self.root):
            self.refused.append(f"its texture {path.name} lies outside of the folder of meshes")
        elif not _is_sound(path):
            self.refused.append(f"its texture {path.name} cannot be read: damaged, or a pointer of Git LFS")
        else:
            return path.read_bytes()
        raise FileNotFoundError(name)

    get = __getitem__

    def _find(self, name: str) -> Path | None:
        folder = self.mesh.parent
        base = Path(name).name
        for path in (folder / name, folder / base, folder.parent / "materials" / "textures" / base):
            if path.is_file():
                return path
            if path.parent.is_dir():
                for other in sorted(path.parent.iterdir()):
                    if other.name.lower() == path.name.lower() and other.is_file():
                        return other
        return None


def _is_sound(path: Path) -> bool:
    """Whether a file is no image, or one that can be decoded."""
    if path.suffix.lower() in (".mtl", ".bin"):
        return True
    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError, ValueError):
        return False
    return True


def import_trimesh() -> ModuleType:
    """Return trimesh; raise CompleteSplatError if it is not installed."""
    try:
        import trimesh
    except ImportError as error:
        advice = f"{install_command('render')}, or renderer=blender"
        raise CompleteSplatError(f"data render needs trimesh to read meshes: {advice}") from error
    return trimesh


def read_mesh(path: Path, root: Path, up: str | None = None) -> TexturedMesh:
    """Read a mesh file with its textures.

    Args:
        path: a file with one of the suffixes in `READABLE`.
        root: folder that all its textures must lie in, with links resolved.
        up: axis that points up in files of `WITHOUT_STANDARD`; None: as in `UP_AXES`.

    Raises:
        BrokenMesh: trimesh cannot read it, a texture is missing or cannot be read, or its faces cannot be drawn.
    """
    trimesh = import_trimesh()
    if path.suffix.lower() == ".ply":
        _require_one_texture(path)
    files: Any = TextureFiles(path, root)
    with path.open("rb") as file:
        try:
            scene = trimesh.load_scene(file, file_type=path.suffix[1:].lower(), resolver=files, process=False)
            geometries = [
                (scene.geometry[name], matrix) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)
            ]
        except Exception as error:  # trimesh raises many kinds for a damaged file
            reason = files.refused[0] if files.refused else f"trimesh cannot read it: {type(error).__name__}"
            raise BrokenMesh(reason) from error
    if files.refused:
        raise BrokenMesh(files.refused[0])
    kind = path.suffix.lower()
    is_gltf = kind in (".glb", ".gltf")
    description = gltf_description(path) if is_gltf else {}
    parts = []
    for geometry, matrix in geometries:
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            _require_texture(geometry, description)
            parts.append(_part(geometry, matrix, is_gltf))
    if not parts:
        raise BrokenMesh("it has no faces")
    axis = up if up is not None and kind in WITHOUT_STANDARD else UP_AXES[kind]
    return _joined(parts, TURNS[axis], _beyond(description))


def _require_one_texture(path: Path) -> None:
    """Refuse a PLY file with several textures, of which trimesh takes the last one for all faces."""
    with path.open("rb") as file:
        header = file.read(LONGEST_HEADER).partition(b"end_header")[0]
    if header.count(b"comment TextureFile") > 1:
        raise BrokenMesh("a PLY file with several textures; save it as .obj or .glb")


def _require_texture(geometry: Any, description: dict[str, Any]) -> None:
    """Refuse a material whose texture trimesh left out without a word."""
    material = getattr(geometry.visual, "material", None)
    named = [x for x in description.get("materials", ()) if x.get("name") == getattr(material, "name", None)]
    wanted = bool(named) and all("baseColorTexture" in x.get("pbrMetallicRoughness", {}) for x in named)
    if wanted and getattr(material, "baseColorTexture", None) is None:
        raise BrokenMesh("it has a texture that cannot be read: damaged, or of a format such as KTX2")


def _beyond(description: dict[str, Any]) -> str:
    """Name what of a glTF's materials only Blender draws."""
    materials = description.get("materials", ())
    extensions = {name for material in materials for name in material.get("extensions", ())}
    words = []
    if any(map(_is_metal, materials)):
        words.append("metal")
    if "KHR_materials_transmission" in extensions:
        words.append("glass")
    if any(material.get("alphaMode") == "BLEND" for material in materials):
        words.append("half-transparent materials")
    if any(any(material.get("emissiveFactor", ())) for material in materials):
        words.append("materials that glow")
    return " and ".join(words)


def _is_metal(material: dict[str, Any]) -> bool:
    """Whether a material of glTF is metal everywhere. Where it says nothing, it is: the standard's default is 1."""
    extensions = material.get("extensions", {})
    if "KHR_materials_unlit" in extensions or "KHR_materials_pbrSpecularGlossiness" in extensions:
        return False
    surface = material.get("pbrMetallicRoughness", {})
    factor: float = surface.get("metallicFactor", 1.0)
    return factor > METAL and "metallicRoughnessTexture" not in surface


def _part(geometry: Any, matrix: Float[np.ndarray, "4 4"], is_gltf: bool) -> _Part:
    """Return a geometry's triangles in the scene's frame, with its colours and its texture."""
    faces = np.asarray(geometry.faces)
    places = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    visual = geometry.visual
    colors = np.ones((len(places), 3))
    uv = np.zeros((len(places), 2))
    image = np.full((1, 1, 4), 255, np.uint8)
    if visual.kind == "vertex":
        stored = np.asarray(visual.vertex_colors)[:, :3] / 255
        colors = stored if is_gltf else to_linear(stored)
    elif visual.kind == "texture":
        image, factor = _material(visual.material, is_gltf)
        colors = colors * factor
        if visual.uv is not None and len(visual.uv) == len(places):
            uv = np.nan_to_num(np.asarray(visual.uv, np.float64)[:, :2])
    elif visual.kind == "face":
        stored = to_linear(np.asarray(visual.face_colors)[:, None, :3] / 255)
        return _Part(places[faces], uv[faces], np.broadcast_to(stored, (len(faces), 3, 3)), image)
    else:
        colors = colors * GREY
    return _Part(places[faces], uv[faces], colors[faces], image)


def _material(material: Any, is_gltf: bool) -> tuple[UInt8[np.ndarray, "height width 4"], Float[np.ndarray, " 3"]]:
    """Return a material's texture (one white pixel if it has none), and the linear colour that it is multiplied by."""
    if is_gltf:
        picture = material.baseColorTexture
        stored = material.baseColorFactor
        factor = np.ones(3) if stored is None else np.asarray(stored, np.float64)[:3] / 255
    else:
        picture = getattr(material, "image", None)
        stored = getattr(material, "diffuse", None)
        plain = np.full(3, GREY) if stored is None else to_linear(np.asarray(stored, np.float64)[:3] / 255)
        factor = plain if picture is None else np.ones(3)
    if picture is None:
        return np.full((1, 1, 4), 255, np.uint8), factor
    reduction = -(-max(picture.size) // MOST_TEXTURE)
    picture = picture.convert("RGBA")
    return np.asarray(picture.reduce(reduction) if reduction > 1 else picture), factor


def to_linear(values: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB values from 0 to 1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def to_srgb(values: np.ndarray) -> np.ndarray:
    """Return sRGB values, 0 to 1, of linear light, which is cut there."""
    values = values.clip(0, 1)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def _joined(parts: list[_Part], turn: Float[np.ndarray, "3 3"], beyond: str) -> TexturedMesh:
    """Join parts to one mesh that stands upright, without stray faces, in the unit ball."""
    corners = np.concatenate([part.corners for part in parts]) @ turn.T
    if not np.isfinite(corners).all():
        raise BrokenMesh("it has vertices that are not finite")
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    stray = stray_faces(corners.reshape(-1, 3), np.full(len(corners), 3), areas)
    corners = corners[~stray]
    low = corners.min((0, 1))
    high = corners.max((0, 1))
    center = (low + high) / 2
    radius = float(np.linalg.norm(corners - center, axis=-1).max())
    if not radius > 1e-12:
        raise BrokenMesh("all its vertices are in one place")
    corners = (corners - center) / radius
    images = [part.image for part in parts]
    return TexturedMesh(
        corners=corners,
        normals=corner_normals(corners),
        uv=np.concatenate([part.uv for part in parts])[~stray],
        colors=np.concatenate([part.colors for part in parts])[~stray],
        texture=np.repeat(np.arange(len(parts)), [len(part.corners) for part in parts])[~stray],
        textures=packed_textures(images),
        cut=any(image[..., 3].min() < 128 for image in images),
        center=center,
        scale=1 / radius,
        left_out=int(stray.sum()),
        beyond=beyond,
    )


def corner_normals(corners: Float[np.ndarray, "triangle 3 3"]) -> Float[np.ndarray, "triangle 3 3"]:
    """Return a unit normal for each corner: the mean of the faces that meet there, or its own face's at an edge.

    Faces count by their angle at the corner, so that it does not matter how they are cut into triangles.
    """
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    first = np.roll(corners, -1, axis=1) - corners
    second = np.roll(corners, 1, axis=1) - corners
    angles = np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), (first * second).sum(-1))
    keys = np.round(corners.reshape(-1, 3) / SAME_PLACE).astype(np.int64)
    _, vertex = np.unique(keys, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1)
    faces = _unit(crosses)[:, None]
    weighted = (angles[..., None] * faces).reshape(-1, 3)
    sums = np.stack([np.bincount(vertex, weighted[:, axis]) for axis in range(3)], 1)
    smooth = _unit(sums)[vertex].reshape(corners.shape)
    agree = (smooth * faces).sum(-1, keepdims=True) > SMOOTH
    return np.where(agree, smooth, faces)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def packed_textures(images: list[UInt8[np.ndarray, "height width 4"]]) -> Textures:
    """Return images in linear light, each with copies of half the size, a quarter, and so on (means of 2 x 2)."""
    table = to_linear(np.arange(256) / 255)
    values = []
    levels = []
    for image in images:
        linear = np.concatenate([table[image[..., :3]], image[..., 3:] / 255], axis=-1)
        copies = [linear]
        while min(copies[-1].shape[:2]) >= 2 * FEWEST_TEXELS:
            height, width = (side // 2 * 2 for side in copies[-1].shape[:2])
            even = copies[-1][:height, :width]
            copies.append(even.reshape(height // 2, 2, width // 2, 2, 4).mean((1, 3)))
        levels.append([copy.shape[1::-1] for copy in copies])
        values += copies
    texels = [np.round(65535 * copy).astype(np.uint16).reshape(-1) for copy in values]
    starts = iter(np.cumsum([0, *map(len, texels)]))
    most = max(map(len, levels))
    rows = []
    for sizes in levels:
        entries = [(next(starts), width, height) for width, height in sizes]
        rows.append(entries + [entries[-1]] * (most - len(entries)))
    return Textures(np.concatenate(texels), np.array(rows, np.int64))
