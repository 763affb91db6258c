import torch

from completesplat.baselines.naive import copy_reference, repeat_image
from completesplat.data.toy.module import ToyObjectsDataModule


def test_naive_predictions(toy_root):
    data = ToyObjectsDataModule(str(toy_root), image_size=16)
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    truth = scenes.all_views().images
    copied = copy_reference(scenes)
    assert copied.shape == truth.shape
    for view in range(truth.shape[1]):
        assert torch.equal(copied[:, view], scenes.reference.images)
    assert torch.equal(copied[:, 0], truth[:, 0])
    image = torch.rand(3, 16, 16)
    assert (repeat_image(image, scenes) == image).all()
    assert repeat_image(image, scenes).shape == truth.shape
