"""Splatter Image's published weights: the network equals upstream's, and other files are refused.

Numbers of upstream are those of its own `GaussianSplatPredictor` and `eval_sh`, run at commit 78a6ad0 of
szymanowiczs/splatter-image on the CPU with the weights of `published_weights.tensors`, and images and cameras as
below.
"""

import hashlib

import pytest
import torch
from published_weights import LARGE, shapes, write_published

from completesplat.baselines.splatter_image.model import PublishedSplatterImage
from completesplat.errors import WeightsError
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer

PICKS = [0, 37, 200]
# Of the second image: Gaussians 0, 37 and 200.
UPSTREAM = {
    "hydrants": {
        "means": [[-0.350282, -1.00824, 2.834701], [0.313312, -0.722214, 3.012812], [1.092185, -0.1653, 3.179528]],
        "from the camera": [[0.182436, 0.472147, 0.382063], [0.694787, 0.655836, 0], [0.812307, 0.178087, 0.222119]],
        "from aside": [[0.207482, 0.490888, 0.418167], [0.702037, 0.64968, 0.078945], [0.76922, 0.182537, 0.248518]],
    },
    "objaverse": {
        "means": [[-0.623258, -1.281215, 1.959149], [0.209749, -0.950052, 1.920655], [1.110913, 0.003249, 2.258371]],
        "from the camera": [[0.191864, 0.459335, 0.450563], [0.679737, 0.676982, 0], [0.785115, 0.16978, 0.191718]],
        "from aside": [[0.238013, 0.485649, 0.493775], [0.686543, 0.670401, 0.156503], [0.720887, 0.173977, 0.217707]],
    },
}
OPACITIES = [0.444734, 0.554385, 0.408983]
SCALES = [[0.94823, 1.345353, 1.587147], [1.053286, 1.027022, 1.659711], [2.214608, 0.794766, 2.734411]]
ROTATIONS = [[0.736375, 0.354048, 0.207043, 0.538084], [-0.156861, 0.21924, -0.70281, 0.658321]]
ROTATIONS += [[0.240327, 0.534756, -0.23621, -0.774909]]
# Mean sizes of all values of both images, which leaves no pixel out.
MEAN_SIZES = {"means": {"hydrants": [1.110143, 1.279431], "objaverse": [1.041324, 1.054789]}}
MEAN_SIZES |= {"quaternions": [0.421106, 0.42302], "scales": [1.52006, 1.56831], "opacities": [0.474545, 0.475816]}


def reconstruct(name, folder):
    model = PublishedSplatterImage(str(write_published(folder, name))).eval()
    images = torch.rand(2, 1, 3, 16, 16, generator=torch.Generator().manual_seed(1))[:, 0]
    focal_lengths = [30.0, 40.0] if model.fov_degrees is None else [pinhole(model.fov_degrees, 16)[0, 0].item()] * 2
    intrinsics = torch.stack([torch.tensor([[f, 0, 8], [0, f, 8], [0, 0, 1.0]]) for f in focal_lengths])
    cameras = Cameras(torch.eye(4).expand(2, 4, 4), intrinsics, (16, 16))
    # Objects at 2.5 and 3; the near end is where the data put it, in front of the camera.
    with torch.no_grad():
        return model(images).splatter_image.gaussians(cameras, torch.tensor([[0.5, 4.5], [1.0, 5.0]]))


@pytest.mark.parametrize("name", UPSTREAM)
def test_the_network_equals_upstreams(name, tmp_path):
    gaussians, expected = reconstruct(name, tmp_path), UPSTREAM[name]

    def equal(result, numbers):
        torch.testing.assert_close(result, torch.tensor(numbers), atol=2e-5, rtol=2e-5)

    second = gaussians[1][PICKS]
    equal(second.means, expected["means"])
    equal(second.quaternions, ROTATIONS)
    equal(second.scales, SCALES)
    equal(second.opacities, OPACITIES)
    equal(second.colors, expected["from the camera"])
    equal(second.seen_from(torch.tensor([1.0, -0.5, 0.3])).colors, expected["from aside"])
    for part, sizes in MEAN_SIZES.items():
        result = getattr(gaussians, part).abs().flatten(1).mean(1)
        equal(result, sizes[name] if part == "means" else sizes)


@pytest.mark.parametrize(("size", "attention", "digest"), [
    (128, [16], "c26cd43a6df095032ea22baee13323bb6a015f81cd29765e1939da2a18d11e0e"),
    (64, [8], "50997d1167476d643dce211b1b0266edd3af2f57df6b9dedb9d8cba2c2656c58"),  # of ShapeNet's 13 categories
])  # fmt: skip
def test_names_and_sizes_of_what_is_published_are_upstreams(size, attention, digest):
    network = {**LARGE, "attention_resolutions": attention}
    lines = [f"{name} {shape}" for name, shape in sorted(shapes(size, network).items())]
    assert hashlib.sha256("\n".join(lines).encode()).hexdigest() == digest


def test_cameras_and_backgrounds_come_with_the_weights(tmp_path):
    of_captures, of_objects = (PublishedSplatterImage(str(write_published(tmp_path, name))) for name in UPSTREAM)
    assert (of_captures.fov_degrees, of_captures.background, of_captures.image_size) == (None, 0, 16)
    assert (of_objects.fov_degrees, of_objects.background) == (pytest.approx(49.1343, abs=1e-3), 1)
    image = torch.zeros(3, 16, 16)
    image[:, 4:12, 5:9] = 0.5  # 8 pixels high: 1.14 units at focal length 16 are 2.28 away
    assert of_captures.object_distance(image, focal_length=16) == pytest.approx(2.28)
    assert of_captures.object_distance(torch.zeros(3, 16, 16), focal_length=16) == pytest.approx(1.14)  # fills it


def test_each_view_is_drawn_in_its_own_colours_and_turning_the_scene_turns_them(tmp_path):
    gaussians = reconstruct("objaverse", tmp_path)
    poses = torch.eye(4).repeat(2, 3, 1, 1)
    poses[:, 1, 0, 3], poses[:, 2, 2, 3] = -1.0, 0.5
    cameras = Cameras(poses, pinhole(49.0, 16).expand(2, 3, 3, 3), (16, 16))
    plain = ReferenceRasterizer()
    rendered = plain(gaussians, cameras)
    for scene in range(2):
        for view in range(3):
            own = gaussians[scene].seen_from(cameras.centers[scene, view])
            expected = plain(own[None], cameras[scene, view][None, None])
            torch.testing.assert_close(vars(rendered[scene, view]), vars(expected[0, 0]))
    first = plain(gaussians.seen_from(cameras.centers[:, 0]), cameras)
    assert not torch.allclose(rendered.color[:, 1], first.color[:, 1], atol=1e-2)
    half_turn = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    moved = gaussians[0].transform(half_turn)
    turned = moved.seen_from(torch.tensor([-1.0, -0.5, -0.3]))
    torch.testing.assert_close(turned.colors, gaussians[0].seen_from(torch.tensor([1.0, -0.5, 0.3])).colors)


NET = "network_with_offset"
CHANGED = {
    "missing": ({f"{NET}.out.bias": None}, f"{NET}.out.bias is missing there"),
    "more": ({"cam_embedding_map.weight": torch.zeros(2)}, "cam_embedding_map.weight has no place here"),
    "size": ({f"{NET}.out.bias": torch.zeros(15)}, r"out.bias is \[15\] there and \[24\] here"),
    "kind": ({f"{NET}.out.bias": torch.zeros(24).double()}, "out.bias is of torch.float64"),
    "filter": ({f"{NET}.encoder.enc.8x8_down.conv0.resample_filter": torch.ones(1, 1, 2, 2)}, "resample_filter has"),
    "harmonics": ({"v_to_sh_transform": torch.eye(3)[None]}, "v_to_sh_transform has other values"),
    "rays": ({"ray_dirs": torch.ones(1, 3, 16, 16)}, "ray_dirs are not those of a camera"),
}


@pytest.mark.parametrize("kind", CHANGED)
def test_every_tensor_is_matched(kind, tmp_path):
    changed, message = CHANGED[kind]
    path = write_published(tmp_path, "hydrants", **changed)
    with pytest.raises(WeightsError, match=rf"model_hydrants.pth: .*{message}"):
        PublishedSplatterImage(str(path))
