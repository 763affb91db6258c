"""Posteriors that see other views: at step 0 the paper's; poses matter, order does not."""

from dataclasses import replace

import pytest
import torch

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.autoreconstructor.view_encoders import PlaneSweep, sweep
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project
from completesplat.scene import Views
from completesplat.splatter_image import Parameterization

SIZE = 16
VIEWS = 4
SIZES = {"channels": (8, 8), "layers_per_block": 1, "norm_groups": 4}
DEPTHS = torch.tensor([[1.0, 4.0]])


def orbit(count=VIEWS):
    angles = torch.linspace(0, 1.2, count)
    eyes = 2.5 * torch.stack([angles.sin(), torch.zeros(count), -angles.cos()], -1)
    poses = look_at(eyes, torch.zeros(count, 3), torch.tensor([0.0, -1.0, 0.0]))
    cameras = Cameras(poses, pinhole(40.0, SIZE).expand(count, 3, 3), (SIZE, SIZE))
    return cameras.relative_to(cameras[:1])[None]


def views():
    images = torch.rand(1, VIEWS, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    return Views(images, orbit(), torch.ones(1, VIEWS, 1, SIZE, SIZE))


@pytest.fixture
def model():
    torch.manual_seed(0)
    reconstructor = Reconstructor(Parameterization(), **SIZES)
    return VariationalAutoReconstructor(
        Encoder(**SIZES), reconstructor, view_encoder=PlaneSweep(planes=3, **SIZES)
    ).eval()


def trained(model):
    """Make no parameter of the view encoder zero, as after some training."""
    with torch.no_grad():
        for parameter in model.view_encoder.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


@torch.no_grad()
def mean(model, seen):
    return model.posterior(seen.images[:, 0], seen, DEPTHS)[0].mean


def test_at_step_0_the_posterior_is_the_papers(model):
    seen = views()
    own, _ = model.encoder(seen.images[:, 0])
    result, _ = model.posterior(seen.images[:, 0], seen, DEPTHS)
    assert torch.equal(result.mean, own.mean)
    assert torch.equal(result.log_variance, own.log_variance)


def test_what_another_view_shows_moves_the_posterior(model):
    seen = views()
    changed = replace(seen, images=torch.cat([seen.images[:, :3], 1 - seen.images[:, 3:]], 1))
    model = trained(model)
    assert not torch.allclose(mean(model, seen), mean(model, changed), atol=1e-4)


def test_poses_matter_and_the_order_of_the_views_does_not(model):
    seen = views()
    model = trained(model)
    order = [0, 3, 1, 2]
    torch.testing.assert_close(mean(model, seen[:, order]), mean(model, seen), atol=1e-4, rtol=1e-4)
    shuffled = replace(seen, cameras=seen.cameras[:, order])
    assert not torch.allclose(mean(model, shuffled), mean(model, seen), atol=1e-4)


def test_with_the_reference_alone_the_posterior_is_the_images(model):
    seen = views()
    model = trained(model)
    own, _ = model.encoder(seen.images[:, 0])
    assert torch.equal(mean(model, seen[:, :1]), own.mean)


def test_a_sweep_finds_the_colours_of_points_where_other_views_see_them():
    """One other image, whose colours are its own pixels' coordinates: it is all that either side sees."""
    seen = views()[:, [0, 1]]
    columns = (torch.arange(SIZE) + 0.5).expand(SIZE, SIZE) / SIZE
    seen = replace(seen, images=torch.stack([columns, columns.T, torch.zeros_like(columns)]).expand(1, 2, 3, -1, -1))
    result = sweep(seen, DEPTHS, planes=3)
    # The middle plane lies at the harmonic mean of near and far, 1.6; its point (3, 4) between pixels 6 and 7, 8 and 9.
    ray = torch.tensor([(7 - SIZE / 2), (9 - SIZE / 2), seen.cameras.intrinsics[0, 0, 0, 0]])
    point = 1.6 * ray / ray[2]
    (place,), _ = project(seen.cameras[0, 1], point[None])
    assert ((place > 1) & (place < SIZE - 1)).all()
    toward = point - seen.cameras.centers[0, 1]
    cosine = torch.nn.functional.cosine_similarity(point, toward, dim=0)
    for side in (0, 1):
        torch.testing.assert_close(result[0, 1, side, :2, 4, 3], place / SIZE * 2 - 1, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(result[0, 1, side, 3, 4, 3], cosine, atol=1e-4, rtol=1e-4)


def test_the_sides_of_a_sweep_are_of_views_along_the_ray_and_against_it():
    reference = Cameras(torch.eye(4), pinhole(40.0, SIZE), (SIZE, SIZE))
    eyes = torch.tensor([[0.0, 0, -0.2], [0, 0, 5.0]])
    others = look_at(eyes, torch.tensor([0.0, 0, 2.5]).expand(2, 3), torch.tensor([0.0, -1.0, 0.0]))
    poses = torch.cat([reference.world_to_camera[None], others])[None]
    cameras = Cameras(poses, reference.intrinsics.expand(1, 3, 3, 3), (SIZE, SIZE))
    images = torch.tensor([0.5, 0.0, 1.0])[None, :, None, None, None].expand(1, 3, 3, SIZE, SIZE)
    result = sweep(Views(images, cameras, torch.ones(1, 3, 1, SIZE, SIZE)), DEPTHS, planes=3)
    along, against = result[0, 1, :, 0, SIZE // 4, SIZE // 4]
    assert along < -0.99
    assert against > 0.99
