"""Program for Blender's Python, or a Python with `bpy`: render one object as a job (a JSON file) describes.

It imports nothing of this package, because Blender's Python does not have it. For every view it writes `NNNN.png`, the
colours, and `NNNN.npy`, float32 [height width 3]: depth along the optical axis, 1 where the pixel's centre shows the
object, and the object's coverage of the pixel. With paints for the back, `K_NNNN.png` has the colours with paint K, and
`NNNN.png` those with paint 0. `result.json` has the object's place and scale, or why it is refused.
"""

import json
import math
import os
import sys
import threading
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

sys.path.append(str(Path(__file__).parent))  # Blender's Python does not look beside a script
from _scene_meshes import RefusedMesh, baked_objects, find_factory, import_mesh, make_object, new_material, normalize

SENSOR = 36.0  # its width; the unit cancels out
BOUNCES = 4
OPEN_GROUND = 30.0  # half size of a floor without walls
TINY_FILTER = 0.01  # Blender's narrowest: the ray of a pixel with one sample goes through its centre


def paint_back(objects: list[Any], toward: list[float], least: float) -> Any:
    """Paint all faces that point away from a camera, and return the socket of the paint's colour.

    These are the faces whose normal n has n . d < -`least`, for the direction d `toward` the camera. A camera at e sees
    the side of a face at p if the side's normal n has n . (e - p) > 0. All points are in the unit ball, so n . p >= -1
    and such an n has n . d > -1 / |e|. With `least` = 1 / |e|, the camera at e therefore sees no paint. Nor does light:
    it is reflected as if there was no paint.
    """
    group = bpy.data.node_groups.new("back", "ShaderNodeTree")
    for side in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Shader", in_out=side, socket_type="NodeSocketShader")
    new = group.nodes.new
    link = group.links.new
    color = new("ShaderNodeRGB")
    paint = new("ShaderNodeBsdfDiffuse")
    mix = new("ShaderNodeMixShader")
    facing = new("ShaderNodeVectorMath")
    away = new("ShaderNodeMath")
    seen = new("ShaderNodeMath")
    facing.operation = "DOT_PRODUCT"
    away.operation = "LESS_THAN"
    seen.operation = "MULTIPLY"
    facing.inputs[1].default_value = toward
    away.inputs[1].default_value = -least
    link(new("ShaderNodeNewGeometry").outputs["True Normal"], facing.inputs[0])
    link(facing.outputs["Value"], away.inputs[0])
    link(away.outputs[0], seen.inputs[0])
    link(new("ShaderNodeLightPath").outputs["Is Camera Ray"], seen.inputs[1])
    link(color.outputs[0], paint.inputs["Color"])
    for socket, source in enumerate((seen, new("NodeGroupInput"), paint)):
        link(source.outputs[0], mix.inputs[socket])
    link(mix.outputs[0], new("NodeGroupOutput").inputs[0])
    for material in {material for part in objects for material in part.data.materials}:
        material.use_nodes = True
        output = material.node_tree.get_output_node("CYCLES")
        if output and output.inputs["Surface"].links:
            node = material.node_tree.nodes.new("ShaderNodeGroup")
            node.node_tree = group
            material.node_tree.links.new(output.inputs["Surface"].links[0].from_socket, node.inputs[0])
            material.node_tree.links.new(node.outputs[0], output.inputs["Surface"])
    return color.outputs[0]


def add_plane(corners: list[tuple[float, float, float]], surface: dict[str, Any]) -> Any:
    """Add a rectangle whose texture coordinates are lengths along its first and last side."""
    mesh = bpy.data.meshes.new("plane")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    width = math.dist(corners[0], corners[1])
    height = math.dist(corners[0], corners[3])
    layer = mesh.uv_layers.new()
    for loop, place in zip(layer.data, [(0, 0), (width, 0), (width, height), (0, height)], strict=True):
        loop.uv = place
    mesh.materials.append(surface_material(**surface))
    plane = bpy.data.objects.new("plane", mesh)
    bpy.context.scene.collection.objects.link(plane)
    return plane


def surface_material(pattern: str, colors: list[list[float]], repeats: float, file: str) -> Any:
    """Return a matt material: an image file, or two colours in a pattern (`checker` or `noise`)."""
    material, shader = new_material()
    shader.inputs["Roughness"].default_value = 0.8
    nodes = material.node_tree.nodes
    link = material.node_tree.links.new
    scale = nodes.new("ShaderNodeVectorMath")
    scale.operation = "SCALE"
    scale.inputs["Scale"].default_value = repeats
    link(nodes.new("ShaderNodeTexCoord").outputs["UV"], scale.inputs[0])
    if pattern == "image":
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.load(file)
        link(scale.outputs[0], texture.inputs["Vector"])
        link(texture.outputs["Color"], shader.inputs["Base Color"])
        return material
    texture = nodes.new("ShaderNodeTexChecker" if pattern == "checker" else "ShaderNodeTexNoise")
    mix = nodes.new("ShaderNodeMixRGB")
    texture.inputs["Scale"].default_value = 1.0
    for name, color in zip(("Color1", "Color2"), colors, strict=True):
        mix.inputs[name].default_value = (*color, 1.0)
    link(scale.outputs[0], texture.inputs["Vector"])
    link(texture.outputs["Fac"], mix.inputs["Fac"])
    link(mix.outputs["Color"], shader.inputs["Base Color"])
    return material


def add_surroundings(job: dict[str, Any], ground: float) -> None:
    """Add the floor below the object and the walls of a room without a ceiling, which throw no shadow."""
    side = job["room"] if job["wall"] else OPEN_GROUND
    square = [(-side, -side), (side, -side), (side, side), (-side, side)]
    if job["floor"]:
        add_plane([(x, y, ground) for x, y in square], job["floor"])
    if job["wall"]:
        for (x, y), (next_x, next_y) in zip(square, [*square[1:], square[0]], strict=True):
            low = ground
            high = ground + 2 * side
            wall = add_plane([(x, y, low), (next_x, next_y, low), (next_x, next_y, high), (x, y, high)], job["wall"])
            wall.visible_shadow = False


def add_light(light: dict[str, Any]) -> None:
    """Add an environment map, or a sun and a sky whose colour goes from the horizon's to the zenith's."""
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes = world.node_tree.nodes
    link = world.node_tree.links.new
    direction = nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    if "file" in light:
        turn = nodes.new("ShaderNodeMapping")
        texture = nodes.new("ShaderNodeTexEnvironment")
        turn.inputs["Rotation"].default_value[2] = light["turn"]
        texture.image = bpy.data.images.load(light["file"])
        link(direction, turn.inputs["Vector"])
        link(turn.outputs["Vector"], texture.inputs["Vector"])
        link(texture.outputs["Color"], nodes["Background"].inputs["Color"])
        return
    height = nodes.new("ShaderNodeSeparateXYZ")
    mix = nodes.new("ShaderNodeMixRGB")
    link(direction, height.inputs[0])
    link(height.outputs["Z"], mix.inputs["Fac"])
    mix.use_clamp = True
    for name, color in zip(("Color1", "Color2"), light["sky"], strict=True):
        mix.inputs[name].default_value = (*color, 1.0)
    link(mix.outputs["Color"], nodes["Background"].inputs["Color"])
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = light["strength"]
    sun.color = light["color"]
    sun.angle = light["angle"]
    lamp = bpy.data.objects.new("sun", sun)
    lamp.rotation_euler = (math.pi / 2 - light["elevation"], 0, light["azimuth"])
    bpy.context.scene.collection.objects.link(lamp)


def set_camera(view: dict[str, Any]) -> None:
    """Set the camera from `world_to_camera` with OpenCV's axes and intrinsics in pixels.

    Blender's camera looks along -z with +y up. Its shifts are in units of the image's width, and move the frame.
    """
    scene = bpy.context.scene
    width, height = view["size"]
    x, y = view["center"]
    scene.render.resolution_x = width
    scene.render.resolution_y = height
    camera = scene.camera
    camera.matrix_world = Matrix(view["world_to_camera"]).inverted() @ Matrix.Diagonal((1, -1, -1, 1))
    camera.data.sensor_fit = "HORIZONTAL"
    camera.data.sensor_width = SENSOR
    camera.data.lens = view["focal"] * SENSOR / width
    camera.data.shift_x = (width / 2 - x) / width
    camera.data.shift_y = (y - height / 2) / width
    camera.data.clip_start = 1e-3
    camera.data.clip_end = 1e4


def set_up_renderer(objects: list[Any]) -> None:
    """Select Cycles on one CPU thread, without its caustics, and mark the object for the coverage pass."""
    scene = bpy.context.scene
    layer = bpy.context.view_layer
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 1
    scene.render.use_persistent_data = True
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.view_settings.view_transform = "Standard"
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    # Colours alone: albedo and normals cost small images more time than samples that reduce noise as much.
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.denoising_input_passes = "RGB"
    layer.use_pass_z = layer.use_pass_object_index = layer.use_pass_cryptomatte_asset = True
    owner = bpy.data.objects.new("object", None)  # parts count as one asset if they have one parent
    scene.collection.objects.link(owner)
    for part in objects:
        part.parent = owner


def set_up_outputs(folder: Path) -> dict[str, Any]:
    """Return nodes that write the object's coverage, and depth with object index, as OpenEXR files into `folder`."""
    scene = bpy.context.scene
    scene.use_nodes = True
    nodes = scene.node_tree.nodes
    link = scene.node_tree.links.new
    nodes.clear()
    layers = nodes.new("CompositorNodeRLayers")
    both = nodes.new("CompositorNodeCombineColor")
    link(layers.outputs["Image"], nodes.new("CompositorNodeComposite").inputs["Image"])
    matte = nodes.new("CompositorNodeCryptomatteV2")
    matte.layer_name = f"{bpy.context.view_layer.name}.CryptoAsset"
    matte.matte_id = "object"
    link(layers.outputs["Image"], matte.inputs["Image"])
    link(layers.outputs["Depth"], both.inputs["Red"])
    link(layers.outputs["IndexOB"], both.inputs["Green"])
    outputs = {}
    for name, socket in {"coverage": matte.outputs["Matte"], "geometry": both.outputs["Image"]}.items():
        outputs[name] = output = nodes.new("CompositorNodeOutputFile")
        output.base_path = str(folder)
        output.file_slots[0].path = f"{name}_"
        output.format.file_format = "OPEN_EXR"
        output.format.color_mode = "RGB"
        output.format.color_depth = "32"
        link(socket, output.inputs[0])
    return outputs


def render(folder: Path, views: list[dict[str, Any]], samples: int, paint: Any, colors: list[list[float]]) -> None:
    """Render all views with every colour of the paint (`[]`: without), then geometry at the pixels' centres.

    Each round over the views writes one of the outputs of `set_up_outputs`, or none (""), and its images.
    """
    scene = bpy.context.scene
    outputs = set_up_outputs(folder)
    # Output, prefix of the images' names, and colour of the paint (None: as it is).
    rounds: list[tuple[str, str, list[float] | None]] = [("coverage", "", colors[0] if colors else None)]
    rounds += [("", f"{index}_", color) for index, color in enumerate(colors) if index]
    rounds.append(("geometry", "", None))
    for written, prefix, color in rounds:
        images = written != "geometry"
        scene.cycles.samples = samples if images else 1
        scene.cycles.use_denoising = images
        scene.cycles.max_bounces = BOUNCES if images else 0
        scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS" if images else "GAUSSIAN"
        scene.cycles.filter_width = 1.5 if images else TINY_FILTER
        for name, output in outputs.items():
            output.mute = name != written
        if color:
            paint.default_value = (*color, 1.0)
        for number, view in enumerate(views):
            set_camera(view)
            scene.frame_current = number
            scene.cycles.seed = number
            scene.render.filepath = str(folder / f"{prefix}{number:04d}.png")
            bpy.ops.render.render(write_still=images)
    for number in range(len(views)):
        geometry = read_exr(folder / f"geometry_{number:04d}.exr")
        coverage = read_exr(folder / f"coverage_{number:04d}.exr")
        np.save(folder / f"{number:04d}.npy", np.concatenate([geometry[..., :2], coverage[..., :1]], axis=-1))


def read_exr(path: Path) -> Any:
    """Return the pixels, float32 [height width 4], in rows from the top."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def run(job: dict[str, Any]) -> dict[str, Any]:
    """Render the job's mesh or procedural object, and return its place and scale, or the reason for a refusal.

    Without views, only look for the factory of procedural objects.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        if not job["views"]:
            find_factory(job["factory"])
            return {}
        if "mesh" in job:
            import_mesh(Path(job["mesh"]), Path(job["root"]), job["up"])
        else:
            make_object(job["factory"], job["seed"])
        objects = baked_objects()
        place: dict[str, Any] = normalize(objects)
    except RefusedMesh as reason:
        return {"refused": str(reason)}
    set_up_renderer(objects)
    hidden = job["hidden"]
    paint = paint_back(objects, hidden["toward"], hidden["least"]) if hidden else None
    add_surroundings(job, place.pop("ground"))
    add_light(job["light"])
    render(Path(job["folder"]), job["views"], job["samples"], paint, hidden["colors"] if hidden else [])
    return place


def end_with_starter() -> None:
    """End this process when its standard input ends, which the process that started it holds open."""
    os.read(0, 1)
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=end_with_starter, daemon=True).start()
    job_file = Path(sys.argv[-1])
    result = run(json.loads(job_file.read_text()))
    job_file.with_name("result.json").write_text(json.dumps(result))
    os._exit(0)  # all is written, and Blender sometimes crashes when it frees its memory
