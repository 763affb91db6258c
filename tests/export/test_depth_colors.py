import torch

from completesplat.export.pictures import color_depth


def lightness(colors):
    return (colors * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(-3)


def test_nearer_is_brighter():
    depth = torch.linspace(1, 20, 100)[None, None]
    colors, (near, far) = color_depth(depth)
    assert (lightness(colors).squeeze().diff() <= 0).all()
    assert 1 <= near < 2
    assert 19 < far <= 20


def test_what_is_not_seen_is_grey_and_does_not_move_the_scale():
    depth = torch.rand(2, 1, 8, 8) + 1
    colors, ends = color_depth(depth)
    holes = torch.cat([depth, torch.tensor([0.0, -1, torch.nan, torch.inf]).expand(2, 1, 8, 4)], dim=-1)
    with_holes, same_ends = color_depth(holes)
    assert same_ends == ends
    assert torch.equal(with_holes[..., :8], colors)
    assert (with_holes[..., 8:] == 0.5).all()


def test_all_pictures_share_one_scale():
    near, far = color_depth(torch.stack([torch.full((1, 4, 4), 1.0), torch.full((1, 4, 4), 9.0)]))[0]
    assert lightness(near).min() > lightness(far).max()


def test_stray_depths_do_not_flatten_the_rest():
    depth = torch.linspace(1, 2, 400).view(1, 20, 20)
    stray = depth.clone()
    stray[0, 0, 0], stray[0, -1, -1] = 1e-3, 1e6
    plain, with_stray = color_depth(depth)[0], color_depth(stray)[0]
    torch.testing.assert_close(with_stray[:, 1:-1], plain[:, 1:-1], rtol=0, atol=0.05)


def test_nothing_seen_and_one_depth_are_pictures_too():
    colors, ends = color_depth(torch.zeros(1, 4, 4))
    assert colors.shape == (3, 4, 4)
    assert ends == (0.0, 0.0)
    assert color_depth(torch.full((1, 4, 4), 3.0))[0].isfinite().all()
