"""ShapeNet-SRN: archives of the true layout, cameras, masks, the reference view, and what is refused."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from srn_trees import DISTANCE, FOCAL, SIZE, SPOT, write_archive

from completesplat.commands.data import prepare
from completesplat.data.srn.module import SRNDataModule, read_intrinsics
from completesplat.errors import BadAnnotation, BadCamera, BadImage, DataError, MissingFile, TooFewFrames
from completesplat.geometry.cameras import invert_rigid, look_at, project

VIEWS = 6


def module(root: Path, **settings) -> SRNDataModule:
    settings = {"image_size": SIZE, "batch_size": 1, "targets": 1, "reference": 3, "background": 1.0} | settings
    return SRNDataModule(str(root), "cars", **settings)


@pytest.fixture
def archive(tmp_path) -> Path:
    write_archive(tmp_path, "cars", {"train": ["a", "b"], "val": ["c"], "test": ["d", "e"]}, VIEWS)
    return tmp_path


def test_each_split_is_its_own_folder(archive):
    data = module(archive)
    names = {split: data.source(split).names for split in ("train", "val", "test")}
    assert names == {"train": ["a", "b"], "val": ["c"], "test": ["d", "e"]}
    assert data.describe()["subset"] == "cars"
    assert data.describe()["protocol_views"] == "reference: view 3; targets: its other frames"


def test_training_chairs_lie_deeper(tmp_path):
    write_archive(tmp_path, "chairs", {"train": ["a"], "val": ["b"], "test": ["c"]}, VIEWS)
    (tmp_path / "chairs_train").rename(tmp_path / "objects")
    (tmp_path / "chairs_train").mkdir()
    (tmp_path / "objects").rename(tmp_path / "chairs_train/chairs_2.0_train")
    data = SRNDataModule(str(tmp_path), "chairs", image_size=SIZE)
    assert data.source("train").names == ["a"]
    assert data.source("test").names == ["c"]


def test_a_point_in_the_world_is_where_the_images_show_it(archive):
    """The archive's images have a dark spot at a point's projection, so a mirrored or turned camera misses it."""
    sequence = module(archive).source("test").read("d")
    seen = project(sequence.cameras, torch.tensor([SPOT], dtype=torch.float64))[0][:, 0]
    for view, (x, y) in enumerate(seen.tolist()):
        image = sequence.read(view).image
        row, column = divmod(int(image[0].argmin()), SIZE)
        assert abs(column + 0.5 - x) <= 1
        assert abs(row + 0.5 - y) <= 1
    distances = sequence.cameras.centers.norm(dim=-1)
    torch.testing.assert_close(distances, torch.full_like(distances, DISTANCE))
    expected = torch.tensor([DISTANCE - 0.5, DISTANCE + 0.5])
    ranges = module(archive, depth_before=0.5, depth_after=0.5).source("test").read("d").depth_ranges
    torch.testing.assert_close(ranges, expected.expand_as(ranges), atol=1e-5, rtol=0)


def test_the_field_of_view_is_splatter_images(archive):
    lens = read_intrinsics(archive / "cars_test/d/intrinsics.txt")
    degrees = 2 * math.degrees(math.atan(0.5 * SIZE / FOCAL))
    assert degrees == pytest.approx(51.98948897809546)
    assert lens.intrinsics[0, 0] == FOCAL


def test_white_is_no_object_and_images_stay_as_they_are(archive):
    data = module(archive)
    data.setup("test")
    (scene,) = list(data.test_dataloader())[:1]
    view = scene.reference.images[0]
    stored = np.asarray(Image.open(archive / "cars_test/d/rgb/000003.png").convert("RGB"))
    np.testing.assert_array_equal((255 * view).round().byte().movedim(0, -1).numpy(), stored)
    assert torch.equal(scene.reference.masks[0, 0] > 0.5, torch.from_numpy((stored < 255).any(-1)))
    assert 0 < scene.reference.masks.mean() < 1


def test_a_pixel_that_is_nearly_white_is_the_objects(archive):
    path = archive / "cars_test/d/rgb/000002.png"
    image = Image.open(path).convert("RGB")
    image.putpixel((0, 0), (255, 255, 254))
    image.save(path)
    mask = module(archive).source("test").read("d").read(2).mask
    assert mask[0, 0, 0] > 0
    assert mask[0, 0, 1] == 0


@pytest.mark.parametrize("prepared", [False, True])
def test_a_protocols_list_chooses_the_scenes_of_the_test_alone(archive, tmp_path, prepared):
    root = archive
    if prepared:
        root = tmp_path / "packed"
        prepare(module(archive), ["train", "test"], root, "bmp", 4, 0, "raise", 0.0)
    data = module(root)
    data.tested_names = ["e"]
    assert data.source("test").names == ["e"]
    assert data.store("test").names == ["e"]
    assert data.source("train").names == ["a", "b"]
    other = module(root)
    other.tested_names = ["e", "x"]
    with pytest.raises(MissingFile, match="lacks 1 of the 2 scenes of the protocol's list: x"):
        other.source("test")


def test_the_reference_is_the_chosen_view_and_all_others_are_targets(archive):
    data = module(archive)
    sequence = data.source("test").read("d")
    assert data.evaluation_views(sequence, "test") == (3, [0, 1, 2, 4, 5])
    assert module(archive, evaluation_targets=2).evaluation_views(sequence, "test") == (3, [1, 4])
    assert module(archive, validation_targets=1).evaluation_views(sequence, "val") == (3, [2])
    with pytest.raises(TooFewFrames, match="6 views, so there is no view 64"):
        module(archive, reference=64).evaluation_views(sequence, "test")


def test_an_object_of_white_images_alone_is_kept(archive):
    """Car 876d92ce6a0e4bf399588eee976baae of the test has white images alone, and published scores count it."""
    for path in (archive / "cars_test/e/rgb").glob("*.png"):
        Image.new("RGBA", (SIZE, SIZE), "white").save(path)
    data = module(archive)
    data.setup("test")
    scenes = list(data.test_dataloader())
    assert sum(len(scene.names) for scene in scenes) == 2


def test_prepared_objects_give_the_same_scenes(archive, tmp_path):
    data = module(archive)
    prepare(data, ["test"], tmp_path / "packed", "bmp", 4, 0, "raise", 0.0)
    stored = module(tmp_path / "packed").source("test").read("d")
    own = data.source("test").read("d")
    assert torch.equal(stored.read(2).image, own.read(2).image)
    torch.testing.assert_close(stored.cameras.world_to_camera, own.cameras.world_to_camera)


def test_the_test_objects_alone_are_enough_for_a_test(archive):
    for split in ("train", "val"):
        shutil.rmtree(archive / f"cars_{split}")
    data = module(archive)
    assert data.source("test").names == ["d", "e"]
    assert data.mean_image() is None
    with pytest.raises(DataError, match="no train sequences that can be used"):
        data.store("train")


def test_missing_test_objects_are_named(archive):
    shutil.rmtree(archive / "cars_test")
    with pytest.raises(MissingFile, match=r"cars_test: no objects with intrinsics\.txt"):
        module(archive).source("test")


def test_a_missing_split_is_named(tmp_path):
    with pytest.raises(
        MissingFile, match=r"cars_test: no objects with intrinsics\.txt; give the folder of the unpacked"
    ):
        module(tmp_path).source("test")


@pytest.mark.parametrize(
    ("file", "text", "error", "message"),
    [
        ("pose/000001.txt", None, BadAnnotation, "6 images in rgb, 5 poses in pose"),
        ("pose/000001.txt", "1 2 3", BadAnnotation, "16 numbers"),
        ("pose/000001.txt", " ".join(["nan"] * 16), BadAnnotation, "finite"),
        ("pose/000001.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", BadCamera, "not orthonormal"),
        ("intrinsics.txt", "131.25 64", BadAnnotation, "needs a line"),
        ("intrinsics.txt", "0 32 32 0\n64 64", BadCamera, "must be positive"),
        ("intrinsics.txt", "x 32 32 0\n64 64", BadAnnotation, "4 numbers"),
    ],
)
def test_damaged_files_are_refused_with_their_names(archive, file, text, error, message):
    path = archive / "cars_test/d" / file
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(error, match=message) as raised:
        module(archive).source("test").read("d")
    assert "cars_test/d" in str(raised.value)


def test_an_image_of_another_size_is_refused(archive):
    Image.new("RGB", (8, 8)).save(archive / "cars_test/d/rgb/000002.png")
    with pytest.raises(BadImage, match=f"8 x 8 pixels, intrinsics.txt says {SIZE} x {SIZE}"):
        module(archive).source("test").read("d").read(2)


def test_the_fingerprint_follows_the_poses(archive):
    before = module(archive).source("test").fingerprint()
    assert module(archive).source("test").fingerprint() == before
    eye = torch.tensor([[0.0, 0.0, DISTANCE]], dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    pose = invert_rigid(look_at(eye, torch.zeros_like(eye), up))[0]
    (archive / "cars_test/d/pose/000000.txt").write_text(" ".join(map(str, pose.flatten().tolist())))
    assert module(archive).source("test").fingerprint() != before
