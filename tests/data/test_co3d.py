"""The data module on toy objects: shapes, frames of reference, protocols and repeatability."""

from pathlib import Path

import numpy as np
import pytest
import torch
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, change, write_tree
from lightning import LightningModule, Trainer
from PIL import Image
from plyfile import PlyData
from realestate10k_trees import epoch, equal

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.co3d.selection import Filters, SeededSplit, SplitMembers, read_category
from completesplat.data.co3d.source import object_placement
from completesplat.data.loading.scenes import SceneStore
from completesplat.data.toy import write_objects
from completesplat.data.toy.objects import SUBSET
from completesplat.errors import DataError
from completesplat.geometry.cameras import project
from completesplat.scene import SceneBatch


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


def test_training_batches_have_the_stated_shapes(toy_root):
    data = module(toy_root, references_per_sequence=3)
    batches = epoch(data.train_dataloader(), 0)
    assert [len(batch.names) for batch in batches] == [2, 2, 2]
    batch = batches[0]
    assert batch.reference.images.shape == (2, 3, 16, 16)
    assert batch.targets.images.shape == (2, 2, 3, 16, 16)
    assert batch.targets.masks.shape == (2, 2, 1, 16, 16)
    assert batch.targets.cameras.world_to_camera.shape == (2, 2, 4, 4)
    assert batch.reference.cameras.image_size == (16, 16)
    assert batch.depth_range.shape == (2, 2)
    assert batch.reference.images.dtype == batch.reference.cameras.world_to_camera.dtype == torch.float32
    assert 0 <= batch.reference.images.min() < batch.reference.images.max() <= 1


def test_the_world_is_the_reference_frame(toy_root):
    for batch in epoch(module(toy_root).train_dataloader(), 0):
        identity = torch.eye(4).expand(2, 4, 4)
        torch.testing.assert_close(batch.reference.cameras.world_to_camera, identity, atol=1e-6, rtol=0)


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
        mask = seen.targets.masks[view, 0][pixels[:, 1], pixels[:, 0]]
        assert (mask > 0).float().mean() > 0.97
    middle = (pose[2, :3] @ center.numpy() + pose[2, 3]) * factor
    assert seen.depth_range.tolist() == pytest.approx([middle - 1, middle + 2], abs=1e-4)
    assert 1.8 < middle < 2.4


def test_the_near_end_stays_in_front_of_the_camera(toy_root):
    near, far = scene(module(toy_root, depth_before=50.0), "test", 0, 0, [1]).depth_range.tolist()
    assert 0 < near < far


def test_pictures_are_the_files_where_nothing_is_resized(toy_root):
    seen = scene(module(toy_root, image_size=32), "train", 1, 2, [0])
    frame = members(toy_root, "train").frames[seen.names][2]
    expected = torch.from_numpy(np.asarray(Image.open(frame.image)).copy()).permute(2, 0, 1) / 255
    torch.testing.assert_close(seen.reference.images, expected)
    mask = torch.from_numpy(np.asarray(Image.open(frame.mask)).copy())[None] / 255
    torch.testing.assert_close(seen.reference.masks, mask)


def test_epochs_differ_and_can_be_repeated(toy_root):
    data = module(toy_root, references_per_sequence=4)
    loader = data.train_dataloader()
    first = epoch(loader, 0)
    assert not equal(first, epoch(loader, 1))
    assert equal(first, epoch(module(toy_root, references_per_sequence=4).train_dataloader(), 0))
    assert not equal(first, epoch(module(toy_root, references_per_sequence=4, seed=1).train_dataloader(), 0))


def test_an_item_draws_other_views_in_another_epoch(toy_root):
    items = module(toy_root, references_per_sequence=4).train_dataloader().dataset
    drawn = [[items[epoch, i].scenes for i in range(8)] for epoch in (0, 1, 1)]
    assert not equal(drawn[0], drawn[1])
    assert equal(drawn[1], drawn[2])


def test_neither_workers_nor_the_cache_change_what_is_drawn(toy_root):
    plain = module(toy_root, references_per_sequence=4, cache=False).train_dataloader()
    loader = module(toy_root, references_per_sequence=4, workers=2).train_dataloader()
    for number in (0, 1):
        assert equal(epoch(plain, number), epoch(loader, number))


def test_evaluation_goes_from_the_first_frame_to_all_others(toy_root):
    data = module(toy_root)
    for loader, split in ((data.test_dataloader(), "test"), (data.val_dataloader(), "val")):
        (batch,) = list(loader)
        expected = scene(data, split, 0, 0, [1, 2, 3])
        assert batch.names == tuple(members(toy_root, split).frames)
        assert torch.equal(batch.reference.images[0], expected.reference.images)
        assert torch.equal(batch.targets.images[0], expected.targets.images)
    (batch,) = list(module(toy_root, evaluation_targets=1).test_dataloader())
    assert batch.targets.images.shape[1] == 1


def test_validation_shows_fewer_targets_than_the_test_where_asked(toy_root):
    data = module(toy_root, validation_targets=2)
    assert [batch.targets.images.shape[1] for batch in (*data.val_dataloader(), *data.test_dataloader())] == [2, 3]
    same = module(toy_root, evaluation_targets=1)
    assert [batch.targets.images.shape[1] for batch in (*same.val_dataloader(), *same.test_dataloader())] == [1, 1]


def test_evaluation_scenes_of_unequal_length_come_one_by_one(tmp_path):
    write_tree(tmp_path, dict(zip("abcd", (4, 3, 4, 4), strict=True)), {"train": "d", "val": "ac", "test": "ab"})
    data = CO3DDataModule(str(tmp_path), CATEGORY, image_size=8, evaluation_batch_size=2)
    assert [batch.targets.images.shape[:2] for batch in data.test_dataloader()] == [(1, 3), (1, 2)]
    assert [batch.targets.images.shape[:2] for batch in data.val_dataloader()] == [(2, 3)]


class Recorder(LightningModule):
    """Keeps the first reference image of every epoch, trains nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen: list[torch.Tensor] = []

    def training_step(self, batch: SceneBatch, index: int) -> torch.Tensor:
        if index == 0:
            self.seen.append(batch.reference.images)
        return self.weight * 0

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize("workers", [0, 1])
def test_lightning_tells_the_sampler_the_epoch(toy_root, workers):
    data = module(toy_root, workers=workers, references_per_sequence=2)
    recorder = Recorder()
    Trainer(
        max_epochs=3, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, limit_val_batches=0,
    ).fit(recorder, datamodule=data)  # fmt: skip
    loader = module(toy_root, references_per_sequence=2).train_dataloader()
    for number, image in enumerate(recorder.seen):
        assert torch.equal(image, epoch(loader, number)[0].reference.images)
    assert len(recorder.seen) == 3


def test_typical_camera_is_the_mean_of_the_training_frames(toy_root):
    data = module(toy_root, depth_before=1.0, depth_after=2.0)
    fov, (near, far), _ = data.typical_camera()
    scenes = [scene(data, "train", i, f, [0]) for i in range(2) for f in range(4)]
    ranges = torch.stack([seen.depth_range for seen in scenes])
    assert (near, far) == pytest.approx(tuple(ranges.mean(dim=0).tolist()))
    # Half of the image over the focal length is the tangent of half of the angle.
    angles = [2 * np.degrees(np.arctan(8 / seen.reference.cameras.intrinsics[0, 0].item())) for seen in scenes]
    assert fov == pytest.approx(np.mean(angles))


def test_mean_image_is_the_mean_of_the_training_frames(toy_root):
    data = module(toy_root)
    images = [scene(data, "train", i, f, [0]).reference.images for i in range(2) for f in range(4)]
    torch.testing.assert_close(data.mean_image(), torch.stack(images).mean(dim=0))


def test_an_empty_split_is_refused_where_it_is_needed(tmp_path):
    write_objects(tmp_path, scenes=1, frames=2, size=8, seed=0, workers=1, progress=False)
    data = CO3DDataModule(str(tmp_path), "toy_objects", subset=SUBSET)
    for stage, split in (("fit", "val"), ("validate", "val"), ("test", "test")):
        with pytest.raises(DataError, match=f"no {split} sequences") as caught:
            data.setup(stage)
        assert caught.value.file == str(tmp_path)


@pytest.mark.parametrize("threshold", [0.25, 0.5, 1.0])
def test_masks_are_soft_or_cut_at_a_probability(toy_root, threshold):
    soft = scene(module(toy_root), "test", 0, 0, [1, 2]).targets.masks
    cut = scene(module(toy_root, mask_threshold=threshold), "test", 0, 0, [1, 2]).targets.masks
    assert ((soft > 0) & (soft < 1)).any()
    assert torch.equal(cut, (soft >= threshold).float())


def test_the_fingerprint_tells_other_annotations_and_lists(tmp_path):
    category = write_tree(tmp_path, {"a": 3, "b": 3, "c": 3}, {"train": ["a"], "val": ["b"], "test": ["c"]})

    def fingerprint() -> str:
        return CO3DDataModule(str(tmp_path), CATEGORY, image_size=8).source("train").fingerprint()

    found = [fingerprint(), fingerprint()]
    change(category / SEQUENCES, lambda entries: entries[0].update(viewpoint_quality_score=0.5))
    found.append(fingerprint())
    change(category / FRAMES, lambda entries: entries[0]["viewpoint"].update(focal_length=[3, 3.1]))
    found.append(fingerprint())
    change(category / SET_LIST, lambda splits: splits["val"].clear())
    found.append(fingerprint())
    assert found[0] == found[1]
    assert len(set(found)) == 4


def test_without_targets_one_picture_of_a_scene_is_read_and_the_references_are_the_same(toy_root, monkeypatch):
    read, picture = [], SceneStore._picture
    monkeypatch.setattr(SceneStore, "_picture", lambda *given: read.append(given) or picture(*given))
    settings = {"references_per_sequence": 4, "horizontal_flip": True, "box_masks": {"probability": 0.5}}
    without = epoch(module(toy_root, targets=0, **settings).train_dataloader(), 0)
    assert len(read) == sum(len(batch.names) for batch in without) == 8
    for batch, other in zip(without, epoch(module(toy_root, targets=1, **settings).train_dataloader(), 0), strict=True):
        assert batch.targets.images.shape == (2, 0, 3, 16, 16)
        assert torch.equal(batch.reference.images, other.reference.images)
        assert torch.equal(batch.visible, other.visible)
