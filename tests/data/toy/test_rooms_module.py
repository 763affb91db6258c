"""Toy rooms as a data module."""

import pytest
import torch

from completesplat.data.toy.module import ToyRoomsDataModule

SMALL = {"scenes": 4, "frames": 8, "height": 18, "image_size": 16, "batch_size": 2, "targets": 2, "evaluation_gap": 5}


@pytest.mark.slow
def test_rooms_are_made_on_first_use_and_kept(tmp_path):
    module = ToyRoomsDataModule(str(tmp_path), **SMALL)
    module.prepare_data()
    written = (tmp_path / "toy_rooms/toy.json").stat().st_mtime_ns
    again = ToyRoomsDataModule(str(tmp_path), **SMALL | {"scenes": 5})
    again.prepare_data()
    assert (tmp_path / "toy_rooms/toy.json").stat().st_mtime_ns == written
    again.setup("fit")
    batch = next(iter(again.train_dataloader()))
    assert batch.targets.images.shape == (2, 2, 3, 16, 16)


@pytest.mark.slow
def test_both_forms_hold_the_same_scenes(tmp_path):
    scenes = []
    for form in ("text", "chunks"):
        module = ToyRoomsDataModule(str(tmp_path), form=form, **SMALL)
        module.prepare_data()
        module.setup("test")
        scenes.append(next(iter(module.test_dataloader())))
    text, chunks = scenes
    assert text.names == chunks.names
    assert torch.equal(text.targets.images, chunks.targets.images)
    torch.testing.assert_close(text.targets.cameras.world_to_camera, chunks.targets.cameras.world_to_camera)
