"""Meshes for `_scene_script.py`, which runs in Blender's Python: import, check of textures, place and scale."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from _placement import stray_faces
from mathutils import Matrix

IMPORTERS = {
    "glb": "import_scene.gltf",
    "gltf": "import_scene.gltf",
    "obj": "wm.obj_import",
    "ply": "wm.ply_import",
    "stl": "wm.stl_import",
    "fbx": "import_scene.fbx",
    "usd": "wm.usd_import",
    "usda": "wm.usd_import",
    "usdc": "wm.usd_import",
    "usdz": "wm.usd_import",
}
# With these, an importer keeps vertices that are not finite, which it would otherwise move to the origin.
UNCHECKED = {"validate_meshes": False}
AS_STORED = {
    "stl": {"use_mesh_validate": False},
    "obj": UNCHECKED,
    "usd": UNCHECKED,
    "usda": UNCHECKED,
    "usdc": UNCHECKED,
    "usdz": UNCHECKED,
}

UP_AXES = {
    "y": {"up_axis": "Y", "forward_axis": "NEGATIVE_Z"},
    "z": {"up_axis": "Z", "forward_axis": "Y"},
}
WITHOUT_STANDARD = ("obj", "ply", "stl")  # other formats say which axis points up


class RefusedMesh(Exception):
    """Mesh that cannot be rendered."""


def import_mesh(path: Path, root: Path, up: str | None) -> None:
    """Import a file into the empty scene, or refuse one that Blender cannot read, or whose textures it cannot use.

    Args:
        up: axis that points up in files of `WITHOUT_STANDARD`; None: Blender's default.
    """
    kind = path.suffix[1:].lower()
    module, name = IMPORTERS[kind].split(".")
    settings: dict[str, Any] = dict(AS_STORED.get(kind, {}))
    if up is not None and kind in WITHOUT_STANDARD:
        settings |= UP_AXES[up]
    try:
        getattr(getattr(bpy.ops, module), name)(filepath=str(path), **settings)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip() and "Location:" not in line]
        reason = lines[-1] if "Traceback" in lines[0] else lines[0]
        raise RefusedMesh(f"Blender cannot import it: {reason.removeprefix('Error: ')}") from None
    for image in list(bpy.data.images):
        find_texture(image, path)
    for image in bpy.data.images:
        check_texture(image, root)
    trees = [material.node_tree for material in bpy.data.materials if material.use_nodes]
    if any(node.type == "TEX_IMAGE" and node.image is None for tree in trees for node in tree.nodes):
        raise RefusedMesh("it has a texture in a format that Blender does not read, such as KTX2")


def find_texture(image: Any, mesh: Path) -> None:
    """Load a missing texture from `materials/textures` beside the mesh's folder (Google Scanned Objects)."""
    file = Path(bpy.path.abspath(image.filepath))
    other = mesh.parent.parent / "materials/textures" / file.name
    if image.filepath and image.packed_file is None and not file.is_file() and other.is_file():
        image.user_remap(bpy.data.images.load(str(other)))
        bpy.data.images.remove(image)


def check_texture(image: Any, root: Path) -> None:
    """Refuse an image of a file outside of the folder of meshes, or one that is missing or cannot be decoded."""
    file = Path(bpy.path.abspath(image.filepath))
    if image.filepath and not file.resolve().is_relative_to(root):
        raise RefusedMesh(f"its texture {file.name} lies outside of the folder of meshes")
    if image.source == "FILE" and image.packed_file is None and not file.is_file():
        raise RefusedMesh(f"its texture {file.name} is missing")
    if image.source == "FILE" and 0 in image.size:
        raise RefusedMesh(f"its texture {image.name} cannot be read: damaged, or a pointer of Git LFS")


def find_factory(name: str) -> Any:
    """Return Infinigen's class of procedural objects, and import only the package that names it to save seconds."""
    try:
        import infinigen.assets.objects as kinds
    except ImportError as error:
        raise RefusedMesh(f"Blender's Python lacks Infinigen ({error}): see completesplat data render --help") from None
    packages = sorted(Path(kinds.__path__[0]).glob("*/__init__.py"))
    named = [path.parent.name for path in packages if re.search(rf"\b{name}\b", path.read_text())]
    if not named:
        raise RefusedMesh(f"Infinigen has no {name}")
    return getattr(import_module(f"{kinds.__name__}.{named[0]}"), name)


def make_object(name: str, seed: int) -> None:
    factory_class = find_factory(name)
    from infinigen.core.util.math import FixedSeed

    with FixedSeed(seed):
        factory = factory_class(seed)
        factory.finalize_assets(factory.spawn_asset(0))


def baked_objects() -> list[Any]:
    """Replace everything in the scene by static meshes, one for each visible instance, and return these."""
    graph = bpy.context.evaluated_depsgraph_get()
    meshes = []
    for instance in graph.object_instances:
        source = instance.object
        if source.type == "MESH" and len(source.data.polygons) and not source.original.hide_render:
            mesh = bpy.data.meshes.new_from_object(source, preserve_all_data_layers=True, depsgraph=graph)
            mesh.transform(instance.matrix_world)
            meshes.append(mesh)
    for imported in list(bpy.data.objects):
        bpy.data.objects.remove(imported)
    if not meshes:
        raise RefusedMesh("it has no faces")
    objects = [bpy.data.objects.new("part", mesh) for mesh in meshes]
    for part in objects:
        bpy.context.scene.collection.objects.link(part)
        part.pass_index = 1
        materials = part.data.materials
        if not materials:
            materials.append(None)
        for slot, material in enumerate(materials):
            materials[slot] = material or colored_material(part.data.color_attributes)
    return objects


def colored_material(attributes: Any) -> Any:
    """Return a material of the vertices' colours, or of Blender's default grey."""
    material, shader = new_material()
    if len(attributes):
        attribute = material.node_tree.nodes.new("ShaderNodeVertexColor")
        attribute.layer_name = attributes[0].name
        material.node_tree.links.new(attribute.outputs["Color"], shader.inputs["Base Color"])
    return material


def new_material() -> tuple[Any, Any]:
    material = bpy.data.materials.new("material")
    material.use_nodes = True
    return material, material.node_tree.nodes["Principled BSDF"]


def normalize(objects: list[Any]) -> dict[str, Any]:
    """Remove stray faces, move the bounding box's centre to the origin and the farthest corner to distance 1.

    Returns:
        The former centre, the factor of the scale, the height of the object's lowest point (`ground`), and the number
        of faces that are left out.
    """
    parts = [faces_of(part.data) for part in objects]
    corners, sizes, areas = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    if not np.isfinite(corners).all():
        raise RefusedMesh("it has vertices that are not finite")
    stray = stray_faces(corners, sizes, areas)
    ends = np.cumsum([len(part.data.polygons) for part in objects])
    for part, mask in zip(objects, np.split(stray, ends[:-1]), strict=True):
        if mask.any():
            remove_faces(part.data, mask)
    points = corners[~stray.repeat(sizes)]
    center = (points.min(0) + points.max(0)) / 2
    radius = float(np.linalg.norm(points - center, axis=1).max())
    if not radius > 1e-12:
        raise RefusedMesh("all its vertices are in one place")
    for part in objects:
        part.data.validate()
        part.data.transform(Matrix.Scale(1 / radius, 4) @ Matrix.Translation((-center).tolist()))
    ground = float((points[:, 2].min() - center[2]) / radius)
    return {"center": center.tolist(), "scale": 1 / radius, "ground": ground, "left_out": int(stray.sum())}


def faces_of(mesh: Any) -> tuple[Any, Any, Any]:
    """Return the places of all faces' corners [n 3], and each face's number of corners and area."""
    places = values_of(mesh.vertices, "co", np.float32, 3).reshape(-1, 3)[values_of(mesh.loops, "vertex_index")]
    sizes = values_of(mesh.polygons, "loop_total")
    areas = values_of(mesh.polygons, "area", np.float32)
    return places.astype(np.float64), sizes, areas.astype(np.float64)


def values_of(items: Any, name: str, kind: Any = np.int32, width: int = 1) -> Any:
    values = np.empty(len(items) * width, kind)
    items.foreach_get(name, values)
    return values


def remove_faces(mesh: Any, mask: Any) -> None:
    grid = bmesh.new()
    grid.from_mesh(mesh)
    bmesh.ops.delete(grid, geom=[face for face, out in zip(grid.faces, mask, strict=True) if out], context="FACES")
    grid.to_mesh(mesh)
    grid.free()
