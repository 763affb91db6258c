import json
import shutil
from itertools import combinations

import numpy as np
import pytest
import torch

from completesplat.data.hidden_modes import DIFFERENCE
from completesplat.data.toy.modes import SAME_IMAGE, frame_camera, unseen
from completesplat.data.toy.module import ToyObjectsDataModule, ToyRoomsDataModule
from completesplat.data.toy.object_scene import PATCH_COLORS, draw_scene, render_frame
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.cameras import pixel_centers, project, unproject


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
    assert scene.modes[scene.true_mode] == told["patch_color"]
    assert batch.names == (name,)
    assert torch.equal(batch.reference.images, scene.scene.reference.images)
    stored = scene.scene.targets.images[0, views]
    # The same frames in the evaluation batch, whose targets are all of them.
    same = (batch.targets.images[0, :, None] == stored).flatten(2).all(2)
    assert same.any(0).all()
    errors = (scene.truths - stored).square().mean((1, 2, 3, 4)).sqrt()
    assert errors[scene.true_mode] < 0.015  # JPEG's
    others = [mode for mode in range(len(PATCH_COLORS)) if mode != scene.true_mode]
    assert errors[others].min() > SAME_IMAGE


def test_modes_differ_in_the_patch_and_nowhere_else_and_the_reference_does_not_show_it(scene):
    assert scene.truths.shape[:2] == (len(PATCH_COLORS), len(scene.views))
    assert torch.equal(scene.probabilities, torch.full((4,), 0.25))
    differences = torch.stack([(one - other).abs().amax(1) for one, other in combinations(scene.truths, 2)])
    assert (differences[:, ~scene.region] <= DIFFERENCE).all()
    assert (differences.amax(0)[scene.region] > DIFFERENCE).all()
    # But for the middles of pixels at its edge.
    assert scene.unseen[list(scene.views)][scene.region].float().mean() > 0.95


def test_versions_share_the_reference_and_show_the_stored_images_in_the_true_mode(toy_root, scene):
    versions = scenes_of(toy_root)[0].versions(0)
    assert versions.names == scene.scene.names * len(PATCH_COLORS)
    assert (versions.reference.images == scene.scene.reference.images).all()
    places = [
        (scene.scene.targets.cameras.world_to_camera[0] == pose).all((1, 2)).nonzero().item()
        for pose in versions.targets.cameras.world_to_camera[0]
    ]
    assert len(places) == 3
    errors = (versions.targets.images - scene.scene.targets.images[:, places]).square().mean((1, 2, 3, 4)).sqrt()
    assert errors.argmin() == scene.true_mode
    assert errors[scene.true_mode] < 0.015  # JPEG's


def test_views_look_at_the_back_and_a_front_that_tells_the_colour_is_refused(toy_root):
    scenes, _ = scenes_of(toy_root, views=1)
    (view,) = scenes[0].views
    # In the frame of the reference, which looks along z.
    axes = scenes[0].scene.targets.cameras.world_to_camera[0, :, 2, :3]
    assert len(axes) == 3
    assert axes[view, 2] == axes[:, 2].min() < -0.3
    scenes.choose = lambda sequence: (len(sequence.frames) // 2, [0])  # the reference looks at the back
    with pytest.raises(DataError, match="tells the patch's colour"):
        scenes[0]


def test_other_data_are_refused(toy_root, tmp_path):
    with pytest.raises(CompleteSplatError, match="needs data whose hidden parts are known: toy objects"):
        ToyRoomsDataModule(str(tmp_path)).hidden_modes(1, 1)
    copy = shutil.copytree(toy_root, tmp_path / "copy")
    path = copy / "toy_objects/toy.json"
    numbers = json.loads(path.read_text())
    path.write_text(json.dumps(numbers | {"seed": 6}))
    scenes, _ = scenes_of(copy)
    with pytest.raises(CompleteSplatError, match=r"not the scene that toy\.json describes") as refusal:
        scenes[0]
    assert not isinstance(refusal.value, DataError)  # which would be skipped
    path.write_text(json.dumps(numbers | {"format": 0}))
    with pytest.raises(DataError, match="another version"):
        scenes_of(copy)
    path.unlink()
    with pytest.raises(DataError, match=r"no toy\.json"):
        scenes_of(copy)


SIZE, FRAMES = 48, 8
SCENE = draw_scene(np.random.default_rng([5, 4]), FRAMES)


@pytest.mark.parametrize("frame", [1, 2])
def test_what_is_seen_looks_the_same_in_both_frames_and_agrees_with_their_depth_maps(frame):
    assert not unseen(SCENE, frame, frame, SIZE).any()
    colors, _, depth = (torch.from_numpy(part) for part in render_frame(SCENE, frame, SIZE))
    pixels = pixel_centers(SIZE, SIZE, dtype=torch.float64).flatten(0, 1)
    points = unproject(frame_camera(SCENE, frame, SIZE), pixels, depth.flatten())
    pixels, ahead = project(frame_camera(SCENE, 0, SIZE), points)
    within = (ahead > 0) & (pixels >= 0).all(-1) & (pixels < SIZE).all(-1)
    columns, rows = pixels.clamp(0, SIZE - 1e-6).floor().long().unbind(-1)
    reference, _, nearest = (torch.from_numpy(part) for part in render_frame(SCENE, 0, SIZE))
    hidden = unseen(SCENE, 0, frame, SIZE).flatten()
    by_depth = ~(within & (ahead < 1.05 * nearest[rows, columns]))
    assert (by_depth == hidden).float().mean() > 0.95  # save at edges
    if frame == 1:
        differences = (reference[rows, columns] - colors.flatten(0, 1)).abs().amax(-1)
        assert 0.1 < hidden.float().mean() < 0.9
        assert differences[~hidden].median() < 0.02
        assert differences[hidden].median() > 0.05
