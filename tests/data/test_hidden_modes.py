"""Hidden modes of toy objects and renders, as they are written and read."""

import gzip
import json
import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch

from completesplat.data.loading.hidden_modes import DIFFERENCE
from completesplat.data.packed.preparation import prepare
from completesplat.data.rendered.random_scenes import PAINTS
from completesplat.data.rendered.rendering import RenderedDataModule
from completesplat.data.toy.data_sets import draw_category
from completesplat.data.toy.module import ToyObjectsDataModule, ToyRoomsDataModule
from completesplat.data.toy.object_scene import PATCH_COLORS, render_frame
from completesplat.data.toy.raytracing import trace
from completesplat.errors import BadAnnotation, CompleteSplatError, DataError
from completesplat.geometry.cameras import Cameras, invert_rigid, pinhole, pixel_centers, project, unproject


def scenes_of(root, views=2, image_size=32):
    module = ToyObjectsDataModule(str(root), image_size=image_size)
    module.setup("test")
    return module.hidden_modes(views, spread_views=3), module


@pytest.fixture(scope="module")
def scene(toy_root):
    return scenes_of(toy_root)[0][0]


@pytest.mark.parametrize("image_size", [32, 20])
def test_the_true_colour_and_no_other_is_what_the_data_module_yields(toy_root, image_size):
    scenes, module = scenes_of(toy_root, image_size=image_size)
    assert len(scenes) == 1
    scene, batch = scenes[0], next(iter(module.test_dataloader()))
    name, views = scene.scene.names[0], list(scene.views)
    told = json.loads((toy_root / "toy_objects" / name / "toy.json").read_text())
    assert scene.modes == tuple(PATCH_COLORS)
    assert scene.modes[scene.true_mode] == told["hidden"]
    assert batch.names == (name,)
    assert torch.equal(batch.reference.images, scene.scene.reference.images)
    stored = scene.scene.targets.images[0, views]
    # The same frames in the evaluation batch, whose targets are all of them.
    same = (batch.targets.images[0, :, None] == stored).flatten(2).all(2)
    assert same.any(0).all()
    errors = (scene.truths - stored).square().mean((1, 2, 3, 4)).sqrt()
    assert errors[scene.true_mode] == 0
    others = [mode for mode in range(len(PATCH_COLORS)) if mode != scene.true_mode]
    assert errors[others].min() > 0.025


def test_modes_differ_in_the_patch_and_nowhere_else_and_the_reference_does_not_show_it(scene):
    assert scene.truths.shape[:2] == (len(PATCH_COLORS), len(scene.views))
    assert torch.equal(scene.probabilities, torch.full((4,), 0.25))
    differences = torch.stack([(one - other).abs().amax(1) for one, other in combinations(scene.truths, 2)])
    assert (differences[:, ~scene.region] <= DIFFERENCE).all()
    assert (differences.amax(0)[scene.region] > DIFFERENCE).all()
    assert scene.unseen[list(scene.views)][scene.region].all()


def test_views_look_at_the_back_and_a_front_that_tells_the_colour_is_refused(toy_root, tmp_path):
    scenes, _ = scenes_of(toy_root, views=1)
    (view,) = scenes[0].views
    # In the frame of the reference, which looks along z.
    axes = scenes[0].scene.targets.cameras.world_to_camera[0, :, 2, :3]
    assert len(axes) == 3
    assert axes[view, 2] == axes[:, 2].min() < -0.3
    copy = shutil.copytree(toy_root, tmp_path / "copy")
    first, second = sorted(next(copy.glob("*/*/red")).iterdir())[:2]
    shutil.copy(second, first)
    with pytest.raises(DataError, match="reference view tells the mode"):
        scenes_of(copy)[0][0]


def test_other_data_are_refused(toy_root, tmp_path):
    with pytest.raises(CompleteSplatError, match="needs data whose hidden parts are known: toy objects"):
        ToyRoomsDataModule(str(tmp_path)).hidden_modes(1, 1)
    copy = shutil.copytree(toy_root, tmp_path / "copy")
    scenes, module = scenes_of(copy)
    folder = copy / "toy_objects" / module.store("test").names[0]
    record = json.loads((folder / "toy.json").read_text())
    (folder / "toy.json").write_text(json.dumps(record | {"hidden": "pink"}))
    with pytest.raises(BadAnnotation, match=r"toy\.json: hidden must be one of red, green, blue, yellow"):
        scenes[0]
    (folder / "toy.json").write_text(json.dumps(record | {"chances": [1, 0]}))
    with pytest.raises(BadAnnotation, match="chances must be 4 numbers"):
        scenes[0]
    (folder / "red/frame000001.jpg").unlink()
    with pytest.raises(DataError, match=r"red/frame000001\.jpg"):
        scenes[0]
    shutil.rmtree(folder / "red")
    with pytest.raises(DataError, match="no test scene has images in each mode, such as red: data toy"):
        scenes_of(copy)


def traced_unseen(toy, reference: int, frame: int, size: int) -> torch.Tensor:
    """Mark the pixels of `frame` whose centre shows what the reference image does not, by rays from its camera."""
    poses = torch.from_numpy(toy.camera_to_world[[frame, reference]])
    camera, other = (Cameras(invert_rigid(p), pinhole(toy.fov_degrees, size).double(), (size, size)) for p in poses)
    depth = torch.from_numpy(render_frame(toy, frame, size)[2]).flatten()
    points = unproject(camera, pixel_centers(size, size, dtype=torch.float64).flatten(0, 1), depth)
    pixels, ahead = project(other, points)
    within = (ahead > 0) & (pixels > 0).all(-1) & (pixels < size).all(-1)
    offsets = points - other.centers
    distances = offsets.norm(dim=-1)
    rays = ((offsets / distances[:, None]) @ other.world_to_camera[:3, :3].mT).numpy()[:, None].copy()
    met = trace(toy.shapes, toy.light, (toy.dome, toy.patch), toy.camera_to_world[reference], rays)[2]
    return ~(within & (torch.from_numpy(met) > 0.999 * distances)).view(size, size)


def test_what_the_reference_hides_is_what_no_ray_from_its_camera_meets(toy_root: Path) -> None:
    (scenes, module), described = scenes_of(toy_root), json.loads((toy_root / "toy_objects/toy.json").read_text())
    scene, name = scenes[0], module.store("test").names[0]
    toy = draw_category("toy_objects", described["seed"], int(name.split("_")[0]), described["frames"], np.ones(3))
    sequence = module.source("test").read(name)
    images, shown = [sequence.read(view).image.float() / 255 for view in range(4)], scene.scene.targets.images[0]
    views = [view for view in range(4) if any(torch.equal(images[view], image) for image in shown)]
    rays = torch.stack([traced_unseen(toy, sequence.frames[0], sequence.frames[view], 32) for view in views])
    assert 0.1 < rays.float().mean() < 0.9
    assert (rays == scene.unseen).float().mean() > 0.9


@pytest.fixture
def renders(toy_root: Path, tmp_path: Path) -> Path:
    """Root of toy objects in the form of renders: files of every paint are those of every patch."""
    category = shutil.copytree(toy_root / "toy_objects", tmp_path / "root/rendered")
    for annotations in category.glob("*.jgz"):
        content = gzip.decompress(annotations.read_bytes())
        annotations.write_bytes(gzip.compress(content.replace(b"toy_objects", b"rendered")))
    for record in category.glob("*_*/toy.json"):
        hidden = json.loads(record.read_text())["hidden"]
        record.with_name("object.json").write_text(json.dumps({"hidden": hidden}))
        record.unlink()
    return category.parent


def test_modes_of_renders_are_the_images_of_every_paint_and_the_true_one_is_the_data_modules(renders: Path) -> None:
    data = RenderedDataModule(str(renders), image_size=32, test_fraction=1.0)
    data.setup("test")
    painted = next(renders.glob("rendered/*/red")).parent.name  # the toys' test scene
    scene = data.hidden_modes(2, 3)[data.store("test").names.index(painted)]
    assert list(PAINTS) == list(PATCH_COLORS)
    assert scene.modes == tuple(PAINTS)
    assert scene.probabilities.tolist() == pytest.approx([0.4, 0.3, 0.2, 0.1])
    told = json.loads((renders / "rendered" / painted / "object.json").read_text())
    assert scene.modes[scene.true_mode] == told["hidden"]
    errors = (scene.truths - scene.scene.targets.images[0, list(scene.views)]).abs().amax((1, 2, 3, 4))
    assert errors[scene.true_mode] == 0
    assert sorted(errors > 0.1) == [False, True, True, True]


def test_renders_without_modes_and_prepared_ones_are_refused(renders: Path, tmp_path: Path) -> None:
    data = RenderedDataModule(str(renders), image_size=32, test_fraction=1.0)
    store = prepare({"test": data.source("test")}, data.packed_settings(), tmp_path / "store", workers=1)
    for mode in renders.glob("rendered/*/red"):
        shutil.rmtree(mode)
    for each in (data, RenderedDataModule(str(store), image_size=32, test_fraction=1.0)):
        with pytest.raises(DataError, match=r"images in each mode, such as red: .* with hidden=modes"):
            each.hidden_modes(2, 3)
