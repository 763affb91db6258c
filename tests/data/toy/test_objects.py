import gzip
import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from packed_sequences import contents
from PIL import Image
from support import refused

from completesplat.data.co3d.annotations import camera_from_viewpoint
from completesplat.data.toy import object_scene, write_objects, write_rooms
from completesplat.data.toy.data_sets import draw_category
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.data.toy.object_scene import CHANCES, PATCH_COLORS, draw_mini, draw_object_scene, render_frame
from completesplat.errors import DataError
from completesplat.geometry.cameras import pixel_centers, project, unproject


def annotations_of(root: Path) -> list[dict]:
    return json.loads(gzip.decompress((root / "toy_objects" / "frame_annotations.jgz").read_bytes()))


def read_depth(root: Path, annotation: dict) -> np.ndarray:
    """As CO3D's `load_16big_png_depth` does it: the bits of a 16-bit image are float16."""
    with Image.open(root / annotation["depth"]["path"]) as png:
        bits = np.frombuffer(np.array(png, dtype=np.uint16), dtype=np.float16)
        return bits.astype(np.float32).reshape(png.size[::-1]) * annotation["depth"]["scale_adjustment"]


@pytest.mark.slow
def test_bytes_depend_on_the_seed_and_not_on_the_workers(tmp_path):
    trees = {}
    for name, seed, workers in (("one", 3, 1), ("two", 3, 2), ("other", 4, 1)):
        write_objects(tmp_path / name, scenes=3, frames=2, size=16, seed=seed, workers=workers, progress=False)
        trees[name] = contents(tmp_path / name)
    assert trees["one"] == trees["two"]
    first_frames = [path for path in trees["one"] if path.endswith("images/frame000001.jpg")]
    assert len(first_frames) == 3
    assert not {trees["one"][path] for path in first_frames} & set(trees["other"].values())


def test_an_interrupted_set_is_made_anew_a_complete_one_kept_and_other_content_refused(tmp_path, capsys):
    settings = {"scenes": 1, "frames": 2, "size": 8, "seed": 0, "workers": 1}
    (tmp_path / ".toy_objects.unfinished" / "00000_bear").mkdir(parents=True)
    category = write_objects(tmp_path, **settings, progress=False)
    assert (category / "toy.json").is_file()
    assert list(tmp_path.glob("[!.]*")) == [category]
    assert not list(tmp_path.glob("*.unfinished"))
    before = {path: path.stat().st_mtime_ns for path in category.rglob("*")}
    assert write_objects(tmp_path, **settings, progress=True) == category
    assert "already" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in category.rglob("*")} == before
    with pytest.raises(DataError, match="toy_objects"):
        write_objects(tmp_path, **{**settings, "seed": 1}, progress=False)


def test_two_runs_that_make_the_same_set_at_once_both_get_it(tmp_path):
    settings = {"scenes": 2, "frames": 2, "size": 8, "seed": 0, "workers": 1, "progress": False}
    with ThreadPoolExecutor(2) as pool:
        runs = [pool.submit(write_objects, tmp_path, **settings) for _ in range(2)]
    assert [run.result() for run in runs] == [tmp_path / "toy_objects"] * 2


def test_splits_share_no_sequence_and_list_every_frame(toy_root):
    lists = json.loads((toy_root / "toy_objects" / "set_lists" / "set_lists_fewview_train.json").read_text())
    names = {split: {name for name, _, _ in entries} for split, entries in lists.items()}
    assert {split: len(members) for split, members in names.items()} == {"train": 2, "val": 1, "test": 1}
    assert len(names["train"] | names["val"] | names["test"]) == 4
    listed = {(name, number, path) for entries in lists.values() for name, number, path in entries}
    annotated = {(a["sequence_name"], a["frame_number"], a["image"]["path"]) for a in annotations_of(toy_root)}
    assert listed == annotated
    assert all((toy_root / path).is_file() for _, _, path in listed)


def test_depth_of_one_view_predicts_another_views_depth(tmp_path):
    write_objects(tmp_path, scenes=2, frames=12, size=48, seed=5, workers=1, progress=False)
    annotations = annotations_of(tmp_path)
    for first, second in ((annotations[3], annotations[4]), (annotations[20], annotations[19])):
        cameras = [camera_from_viewpoint(a["viewpoint"], a["image"]["size"]) for a in (first, second)]
        depths = [torch.from_numpy(read_depth(tmp_path, a)).double() for a in (first, second)]
        pixels = pixel_centers(48, 48, dtype=torch.float64).flatten(0, 1)
        seen_at, depth = project(cameras[1], unproject(cameras[0], pixels, depths[0].flatten()))
        inside = (seen_at > 1).all(-1) & (seen_at < 47).all(-1)
        column, row = seen_at[inside].long().unbind(-1)
        around = torch.nn.functional.unfold(depths[1][None, None], 3, padding=1).view(9, 48, 48)[:, row, column]
        assert inside.sum() > 500
        in_front = depth[inside] < 0.99 * around.amin(0)
        behind = depth[inside] > 1.01 * around.amax(0)
        assert in_front.double().mean() < 0.01
        assert behind.double().mean() < 0.3  # the object hides part of the ground and of itself


def test_masks_are_soft_mass_is_their_sum_and_the_hidden_attribute_is_recorded(toy_root):
    for annotation in annotations_of(toy_root):
        mask = np.asarray(Image.open(toy_root / annotation["mask"]["path"])) / 255
        assert (mask.min(), mask.max()) == (0, 1)
        assert ((mask > 0) & (mask < 1)).any()
        assert annotation["mask"]["mass"] == pytest.approx(mask.sum(), abs=0.002 * mask.size)
        name = annotation["sequence_name"]
        record = json.loads((toy_root / "toy_objects" / name / "toy.json").read_text())
        assert name.endswith(record["family"])
        assert record["hidden"] in PATCH_COLORS


def test_both_families_and_all_patch_colors_occur():
    scenes = [draw_object_scene(np.random.default_rng([0, index]), frames=2) for index in range(12)]
    assert {scene.family for scene in scenes} == {"bear", "hydrant"}
    assert {scene.patch_color for scene in scenes} == set(PATCH_COLORS)


def nose_is_dark(scene):
    """Return whether the rendered nose is dark. It is the only grey thing on the object."""
    image, coverage, _ = render_frame(scene, 0, 64)
    pixels = image[coverage > 0.99]
    grey = pixels[np.ptp(pixels, axis=-1) < 0.03 * pixels.max(-1)]
    return bool(np.median(grey) < 0.2)


@pytest.fixture(scope="module")
def marked():
    """Marked minis, whose clouds have few points, because all of them would cost nine tenths of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(object_scene, "SURFACE_DIRECTIONS", 4)
        return [draw_mini(np.random.default_rng([1, i]), 2, marked=True) for i in range(160)]


@pytest.mark.parametrize("mark", CHANCES)
def test_colours_of_marked_minis_come_as_often_as_the_nose_says(mark, marked):
    scenes = [scene for scene in marked if np.array_equal(scene.chances, CHANCES[mark])]
    assert 50 < len(scenes) < 110
    assert all(nose_is_dark(scene) == (mark == "dark") for scene in scenes[:20])
    counts = Counter(scene.patch_color for scene in scenes)
    shares = np.array([counts[name] / len(scenes) for name in PATCH_COLORS])
    # Three standard deviations of a share of 80 draws are 0.16.
    np.testing.assert_allclose(shares, CHANCES[mark], atol=0.16)


def test_hidden_modes_of_written_minis_are_known_with_their_probabilities(tmp_path, monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)  # so that no process has to be started
    data = ToyObjectsDataModule(str(tmp_path), 6, 12, category="toy_marked_minis", make=True, image_size=32)
    data.prepare_data()
    scenes = data.hidden_modes(views=2, spread_views=2)
    for scene in (scenes[i] for i in range(len(scenes))):
        assert sorted(scene.probabilities.tolist()) == pytest.approx(sorted(CHANCES["dark"]))
        assert torch.equal(scene.truths[scene.true_mode], scene.scene.targets.images[0, list(scene.views)])
        assert scene.region.any()
        assert torch.unique(scene.truths.flatten(1), dim=0).shape[0] == 4


LIGHT = (1.0, 0.75, 0.5)


def test_the_light_colours_what_it_falls_on_and_nothing_else():
    white, lit = (draw_category("toy_minis", 0, 1, 2, np.array(light)) for light in ((1.0, 1.0, 1.0), LIGHT))
    (image, coverage, depth), (other, *geometry) = (render_frame(scene, 1, 24) for scene in (white, lit))
    assert np.array_equal([coverage, depth], geometry)
    np.testing.assert_allclose(other[coverage == 1], image[coverage == 1] * LIGHT)
    assert np.array_equal(other[coverage == 0], image[coverage == 0])  # the dome
    np.testing.assert_allclose(lit.point_colors, white.point_colors * LIGHT)
    ground = draw_category("toy_objects", 0, 1, 2, np.array(LIGHT)), draw_category("toy_objects", 0, 1, 2, np.ones(3))
    lowest, expected = (render_frame(scene, 1, 24)[0][-1] for scene in ground)
    np.testing.assert_allclose(lowest, expected * LIGHT)


def test_rooms_are_lit_too(tmp_path):
    settings = {"scenes": 2, "frames": 2, "size": 16, "seed": 0, "workers": 1, "progress": False}
    lights = {"a": (1, 1, 1), "b": LIGHT}
    folders = [write_rooms(tmp_path / name, **settings, light=light) for name, light in lights.items()]
    images = [sorted(folder.glob("text/*/*/*.jpg")) for folder in folders]
    assert len(images[0]) == 4
    means = [[np.asarray(Image.open(path)).mean((0, 1)) for path in paths] for paths in images]
    np.testing.assert_allclose(means[1], np.array(means[0]) * LIGHT, atol=3)  # JPEG's


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """Root of scenes under another light."""
    root = tmp_path_factory.mktemp("lit")
    write_objects(root, scenes=3, frames=4, size=32, seed=0, workers=1, light=LIGHT, progress=False)
    return root


def test_hidden_modes_are_written_in_the_same_light(lit):
    module = ToyObjectsDataModule(str(lit), image_size=32)
    module.setup("test")
    scene = module.hidden_modes(views=2, spread_views=2)[0]
    assert torch.equal(scene.truths[scene.true_mode], scene.scene.targets.images[0, list(scene.views)])


def test_a_folder_keeps_its_light_and_white_light_is_not_named(lit, toy_root):
    settings = {"scenes": 3, "frames": 4, "size": 32, "seed": 0, "workers": 1, "progress": False}
    assert write_objects(lit, **settings, light=list(LIGHT)) == lit / "toy_objects"
    with pytest.raises(DataError, match="already holds something else"):
        write_objects(lit, **settings)
    assert write_objects(toy_root, **(settings | {"scenes": 4}), light=[1, 1, 1]) == toy_root / "toy_objects"
    assert "light" not in json.loads((toy_root / "toy_objects/toy.json").read_text())


@pytest.mark.parametrize(("light", "reason"), [("[1,1]", "must have 3 entries"), ("[1,-1,1]", "must be at least 0")])
def test_a_light_that_is_no_colour_is_refused(light, reason):
    assert reason in refused("data", "data_task=toy", f"light={light}")
