from pathlib import Path

import numpy as np
import pytest
import torch
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, write_tree
from PIL import Image
from plyfile import PlyData
from realestate10k_trees import epoch, equal, same
from support import change_json

from completesplat.data.co3d.category import Filters, SplitMembers, read_category
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.co3d.source import object_placement
from completesplat.data.loading.scenes import SceneStore
from completesplat.data.splits import SeededSplit
from completesplat.data.toy.data_sets import SUBSET
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import project
from completesplat.scene import SceneBatch


@pytest.mark.parametrize("spread", [False, True])
def test_targets_that_no_sequence_has_are_refused_before_training_and_short_sequences_are_skipped(tmp_path, spread):
    settings = {"image_size": 8, "batch_size": 1, "spread_targets": spread, "max_bad_fraction": 10.0}
    write_tree(tmp_path, {"a": 3, "b": 5, "v": 5, "t": 5}, {"train": "ab", "val": "v", "test": "t"})
    with pytest.raises(CompleteSplatError, match=r"^data\.targets=5: .* at most 5 frames"):
        CO3DDataModule(str(tmp_path), CATEGORY, targets=5, **settings).setup("fit")
    data = CO3DDataModule(str(tmp_path), CATEGORY, targets=4, **settings)
    data.setup("fit")
    loader = data.train_dataloader()
    assert {name for batch in loader for name in batch.names} == {"b"}
    assert {(error.kind, error.sequence) for error in loader.refused} == {("too few frames", "a")}


def module(root: Path, **settings) -> CO3DDataModule:
    defaults = {"subset": SUBSET, "image_size": 16, "batch_size": 2, "targets": 2}
    data = CO3DDataModule(str(root), "toy_objects", **defaults | settings)
    data.setup()
    return data


def members(root: Path, split: str) -> SplitMembers:
    return read_category(root, "toy_objects", SUBSET, SeededSplit(0.1, 0.1, 0), Filters()).splits[split]


def scene(data: CO3DDataModule, split: str, index: int, reference: int, targets: list[int]) -> SceneBatch:
    store = data.store(split)
    return store.scene(store.source.read(store.names[index]), reference, targets)


def test_the_object_is_at_the_common_scale_and_inside_the_depth_range(toy_root):
    """The point cloud, brought into the reference frame, spans 0.57 and projects onto every view's mask."""
    seen = scene(module(toy_root, depth_before=1.0, depth_after=2.0), "test", 0, 0, [1, 2, 3])
    ((name, frames),) = members(toy_root, "test").frames.items()
    cloud = toy_root / "toy_objects" / name / "pointcloud.ply"
    center, half_size = object_placement(cloud, frames, frames)
    factor = 0.57 / half_size
    vertices = PlyData.read(str(cloud))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    assert 0.57 <= np.linalg.norm(points - center.numpy(), axis=-1).max() * factor <= 0.57 * 3**0.5
    pose = frames[0].camera.world_to_camera.numpy()
    local = torch.from_numpy((points @ pose[:3, :3].T + pose[:3, 3]) * factor).float()
    for view in range(3):
        pixels = project(seen.targets.cameras[view], local)[0].long()
        assert (seen.targets.masks[view, 0][pixels[:, 1], pixels[:, 0]] > 0).float().mean() > 0.97
    middle = (pose[2, :3] @ center.numpy() + pose[2, 3]) * factor
    assert seen.depth_range.tolist() == pytest.approx([middle - 1, middle + 2], abs=1e-4)
    assert 1.8 < middle < 2.4
    # The near end stays in front of the camera.
    near, far = scene(module(toy_root, depth_before=50.0), "test", 0, 0, [1]).depth_range.tolist()
    assert 0 < near < far


def test_images_are_the_files_and_masks_may_be_cut_at_a_probability(toy_root):
    seen = scene(module(toy_root, image_size=32), "train", 1, 2, [0]).reference
    frames = list(members(toy_root, "train").frames.values())[1]
    expected, soft = (torch.from_numpy(np.array(Image.open(file))) / 255 for file in (frames[2].image, frames[2].mask))
    torch.testing.assert_close(seen.images, expected.permute(2, 0, 1))
    torch.testing.assert_close(seen.masks, soft[None])
    assert ((soft > 0) & (soft < 1)).any()
    for threshold in (0.25, 1.0):
        data = module(toy_root, image_size=32, mask_threshold=threshold)
        assert torch.equal(scene(data, "train", 1, 2, [0]).reference.masks[0], (seen.masks[0] >= threshold).float())


def test_the_seed_and_not_the_cache_changes_what_is_drawn(toy_root):
    plain, other, seeded = (
        module(toy_root, references_per_sequence=4, **settings).train_dataloader()
        for settings in ({}, {"cache": True}, {"seed": 1})
    )
    first, second = epoch(plain, 0), epoch(plain, 1)
    assert equal(first, epoch(other, 0))
    assert equal(second, epoch(other, 1))
    assert not equal(first, second)
    assert not equal(first, epoch(seeded, 0))


def test_evaluation_goes_from_the_first_frame_to_all_others_or_to_as_many_as_asked_for(toy_root):
    data = module(toy_root)
    for loader, split in ((data.test_dataloader(), "test"), (data.val_dataloader(), "val")):
        (batch,) = list(loader)
        assert batch.names == tuple(members(toy_root, split).frames)
        assert same(batch[0], scene(data, split, 0, 0, [1, 2, 3]))
    for settings, counts in (({"validation_targets": 2}, [2, 3]), ({"evaluation_targets": 1}, [1, 1])):
        data = module(toy_root, **settings)
        assert [b.targets.images.shape[1] for b in (*data.val_dataloader(), *data.test_dataloader())] == counts


def test_evaluation_scenes_of_unequal_length_come_one_by_one(tmp_path):
    write_tree(tmp_path, dict(zip("abcde", (4, 3, 4, 4, 4), strict=True)), {"train": "d", "val": "ce", "test": "ab"})
    data = CO3DDataModule(str(tmp_path), CATEGORY, image_size=8, evaluation_batch_size=2)
    assert [batch.targets.images.shape[:2] for batch in data.test_dataloader()] == [(1, 3), (1, 2)]
    assert [batch.targets.images.shape[:2] for batch in data.val_dataloader()] == [(2, 3)]


def test_typical_camera_and_mean_image_are_the_means_of_the_training_frames(toy_root):
    data = module(toy_root, depth_before=1.0, depth_after=2.0)
    fov, (near, far), _ = data.typical_camera()
    scenes = [scene(data, "train", i, f, [0]) for i in range(2) for f in range(4)]
    ranges = torch.stack([seen.depth_range for seen in scenes])
    assert (near, far) == pytest.approx(tuple(ranges.mean(dim=0).tolist()))
    # Half of the image over the focal length is the tangent of half of the angle.
    angles = [2 * np.degrees(np.arctan(8 / seen.reference.cameras.intrinsics[0, 0].item())) for seen in scenes]
    assert fov == pytest.approx(np.mean(angles))
    torch.testing.assert_close(data.mean_image(), torch.stack([seen.reference.images for seen in scenes]).mean(dim=0))


def test_the_fingerprint_tells_other_annotations_and_lists(tmp_path):
    category = write_tree(tmp_path, {"a": 3, "b": 3, "c": 3}, {"train": ["a"], "val": ["b"], "test": ["c"]})

    def fingerprint() -> str:
        return CO3DDataModule(str(tmp_path), CATEGORY, image_size=8).source("train").fingerprint()

    result = [fingerprint()]
    assert fingerprint() == result[0]
    for file, edit in (
        (SEQUENCES, lambda entries: entries[0].update(viewpoint_quality_score=0.5)),
        (FRAMES, lambda entries: entries[0]["viewpoint"].update(focal_length=[3, 3.1])),
        (SET_LIST, lambda splits: splits["val"].clear()),
    ):
        change_json(category / file, edit)
        result.append(fingerprint())
    assert len(set(result)) == 4


def test_without_targets_one_image_of_a_scene_is_read_and_the_references_are_the_same(toy_root, monkeypatch):
    read, original = [], SceneStore._read
    monkeypatch.setattr(SceneStore, "_read", lambda *given: read.append(given) or original(*given))
    settings = {"references_per_sequence": 4, "horizontal_flip": True, "box_masks": {"probability": 0.5}}
    without = epoch(module(toy_root, targets=0, **settings).train_dataloader(), 0)
    assert len(read) == sum(len(batch.names) for batch in without) == 8
    for batch, other in zip(without, epoch(module(toy_root, targets=1, **settings).train_dataloader(), 0), strict=True):
        assert batch.targets.images.shape == (2, 0, 3, 16, 16)
        assert torch.equal(batch.reference.images, other.reference.images)
        assert torch.equal(batch.visible, other.visible)
