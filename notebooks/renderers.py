"""Compare the renderer of meshes with Blender: ten textured meshes, equal cameras, light and samples.

COMPLETESPLAT_BLENDER=BPY_PYTHON python notebooks/renderers.py OUT [MESHES]

Without a folder of MESHES, ten are made. A row has the mean over all views of: overlap of the masks (IoU), median error
of depth, mean differences of sRGB values on the object and around it (signed: above 0 if the renderer of meshes is
brighter, and absolute, of 255), and CPU seconds of a view, with all that a job does. OUT has a sheet of both, too.
"""

import resource
import sys
from pathlib import Path
from threading import Event

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from completesplat.data.rendered.assets import find_meshes
from completesplat.data.rendered.blender import find_blender, run_job
from completesplat.data.rendered.mesh_renderer import draw_job
from completesplat.data.rendered.random_scenes import draw_rendered_scene

VIEWS, SIZE, SAMPLES = 3, 128, 16
SETTINGS = {"views": VIEWS, "size": SIZE, "samples": SAMPLES, "cameras": "turn", "front": None, "fov": [36, 55]}
SETTINGS |= {"light": "random", "hidden": "none", "seed": 0, "up": None}
PLACES = {"floor": ("random", "none"), "room": ("random", "random")}
MEMORY = 8_000_000_000


def picture(rng, text):
    """Return an image of discs of random colours, with a text on it."""
    image = Image.new("RGB", (512, 512), tuple(rng.integers(40, 255, 3).tolist()))
    draw = ImageDraw.Draw(image)
    for _ in range(60):
        x, y = rng.uniform(0, 512, 2)
        radius = rng.uniform(8, 60)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), tuple(rng.integers(0, 255, 3).tolist()))
    draw.text((40, 200), text, (255, 255, 255), font_size=96, stroke_width=6, stroke_fill=(0, 0, 0))
    return image


def textured(mesh, image):
    """Return a mesh whose faces show the image, projected along the nearest axis."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    axis = np.abs(mesh.face_normals).argmax(1).repeat(3)
    others = np.array([(2, 1), (0, 2), (0, 1)])[axis]
    uv = np.take_along_axis(corners, others, 1) / mesh.extents.max() + 0.5
    kind = trimesh.visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.0)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=kind)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), visual=visual, process=False)


def make_meshes(folder):
    """Write ten meshes; glTF's y points up."""
    create = trimesh.creation
    tilt = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))
    legs = [create.box((0.1, 0.8, 0.1)).apply_translation((x, -0.45, z)) for x in (-0.6, 0.6) for z in (-0.4, 0.4)]
    shapes = {
        "annulus": create.annulus(0.5, 0.8, 0.5).apply_transform(tilt),
        "ball": create.icosphere(4),
        "box": create.box((1, 0.7, 0.5)),
        "capsule": create.capsule(1, 0.4),
        "carton": create.box((0.6, 1.2, 0.4)),
        "cone": create.cone(0.6, 1.3, sections=64).apply_transform(tilt),
        "cylinder": create.cylinder(0.5, 1.2, sections=64).apply_transform(tilt),
        "gem": create.icosahedron(),
        "table": trimesh.util.concatenate([create.box((1.4, 0.1, 1)), *legs]),
        "torus": create.torus(0.6, 0.25).apply_transform(tilt),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, shape) in enumerate(shapes.items()):
        textured(shape, picture(np.random.default_rng(number), name)).export(folder / f"{name}.glb")


def cpu_seconds():
    """Return the CPU time of this process and of those that it has started."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def views_of(folder):
    """Return images [view height width 3], and depth, mask and coverage [view height width 3]."""
    images = [np.asarray(Image.open(path).convert("RGB"), float) for path in sorted(folder.glob("????.png"))]
    return np.array(images), np.array([np.load(path) for path in sorted(folder.glob("????.npy"))])


def compare(mesh, blender):
    """Return IoU, error of depth, and signed and absolute differences on the object and around it."""
    (ours, ours_geometry), (theirs, theirs_geometry) = views_of(mesh), views_of(blender)
    coverage = np.stack([ours_geometry[..., 2], theirs_geometry[..., 2]])
    both = (ours_geometry[..., 1] == 1) & (theirs_geometry[..., 1] == 1)
    depth = np.abs(ours_geometry[..., 0] - theirs_geometry[..., 0])[both]
    difference = ours - theirs
    inside = coverage.min(0) > 0.99
    outside = coverage.max(0) < 0.01
    figures = [coverage.min(0).sum() / coverage.max(0).sum(), np.median(depth)]
    for region in (inside, outside):
        figures += [difference[region].mean(), np.abs(difference[region]).mean()]
    return figures


def sheet(folders):
    """Return the first two views of each object: the renderer of meshes above Blender."""
    rows = []
    for pair in folders:
        rows.append(np.concatenate([np.concatenate(views_of(folder)[0][:2], axis=1) for folder in pair], axis=0))
    return Image.fromarray(np.concatenate(rows, axis=1).astype(np.uint8))


def main(out, meshes):
    program = find_blender(None)
    for place, (floor, wall) in PLACES.items():
        rows = []
        seconds = np.zeros(2)
        folders = []
        for asset in find_meshes(meshes):
            job, _ = draw_rendered_scene(asset.key, SETTINGS | {"floor": floor, "wall": wall})
            job |= {"mesh": str(asset.mesh.absolute()), "root": str(meshes.resolve()), "memory": MEMORY}
            pair = [out / place / kind / asset.name for kind in ("mesh", "blender")]
            for number, folder in enumerate(pair):
                folder.mkdir(parents=True, exist_ok=True)
                job["folder"] = str(folder.absolute())
                if not number:
                    draw_job(job | {"views": job["views"][:1]}, Event())  # compiles
                start = cpu_seconds()
                result = run_job(program, job, folder, Event(), 10.0) if number else draw_job(job, Event())
                seconds[number] += cpu_seconds() - start
                assert "refused" not in result, result
            folders.append(pair)
            rows.append(compare(*pair))
            print(
                f"| {place} | {asset.name} | " + " | ".join(f"{figure:.4g}" for figure in rows[-1]) + " |", flush=True
            )
        each = seconds / len(rows) / VIEWS
        mean = " | ".join(f"{figure:.4g}" for figure in np.mean(rows, axis=0))
        print(f"| {place} | mean | {mean} | {each[0]:.3f} and {each[1]:.3f} s a view", flush=True)
        sheet(folders).save(out / f"{place}.png")


if __name__ == "__main__":
    target = Path(sys.argv[1])
    source = Path(sys.argv[2]) if len(sys.argv) > 2 else target / "meshes"
    if len(sys.argv) <= 2:
        make_meshes(source)
    main(target, source)
