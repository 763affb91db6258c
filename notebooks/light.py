"""How well raw Splatter Images fit turns of fruit: one colour, light divided out, harmonics (experiments.md, "Fruit").

The light is the mean of log luminance over all training photos, at each position in the object's box. Each scene's
Splatter Image is optimised on every second photo and scored on all. Run it beside the data set FRUIT_TURNS.
"""

import torch

import completesplat
from completesplat.rasterizers.selection import auto
from completesplat.splatter_image import Parameterization, SplatterImage

SIZE, STEPS = 24, 400
data, _ = completesplat.instantiate(
    completesplat.compose(
        "fit",
        "experiment=turntable_var",
        "data.root=FRUIT_TURNS",
        "data.evaluation_targets=35",
        "data.color_jitter=null",
        "data.camera_jitter=null",
        "data.horizontal_flip=false",
        "data.targets=9",
        "data.workers=0",
    )
)
data.setup("fit")
data.setup("test")


def places(images):
    """Return positions within the object's box, -1 to 1 [view 2 height width], and masks."""
    masks = images.amin(1) < 0.97
    grid = torch.stack(torch.meshgrid(*(torch.arange(s) + 0.5 for s in masks.shape[1:]), indexing="ij")).flip(0)
    low, high = (torch.stack([fold(grid[:, mask], 1) for mask in masks]) for fold in (torch.amin, torch.amax))
    return (2 * grid - (low + high)[..., None, None]) / (high - low)[..., None, None], masks


total, count = torch.zeros(SIZE**2), torch.zeros(SIZE**2)
for batch in data.train_dataloader():
    images = batch.all_views().images.flatten(0, 1)
    place, mask = places(images)
    mask = -torch.nn.functional.max_pool2d(-mask.float(), 3, 1, 1) > 0  # without the border, which is partly white
    light = images.mean(1).clamp(0.02).log()
    light -= (light * mask).sum((1, 2), keepdim=True) / mask.sum((1, 2), keepdim=True)
    column, row = ((place.clamp(-0.999, 0.999) + 1) / 2 * SIZE).long().unbind(1)
    total.index_add_(0, (row * SIZE + column)[mask], light[mask])
    count.index_add_(0, (row * SIZE + column)[mask], torch.ones(int(mask.sum())))
shading = (total / (count + 0.001 * count.max())).exp().view(1, 1, SIZE, SIZE)


def light_of(images):
    """Return the factor that the light has at each pixel [view 1 height width]."""
    place, mask = places(images)
    values = torch.nn.functional.grid_sample(
        shading.expand(len(images), -1, -1, -1), place.permute(0, 2, 3, 1), align_corners=False
    )
    return torch.where(mask[:, None], values, 1.0)


def fit(scene, degree, light):
    """Return the mean PSNR of fitted views and of those between, in dB."""
    torch.manual_seed(0)
    views, settings = scene.all_views(), Parameterization(harmonics=degree)
    images = views.images[0]
    start = SplatterImage(torch.zeros(1, 2, settings.layer_channels, *images.shape[-2:]), settings)
    parts = {name: torch.zeros_like(part) for name, part in start.split().items()}
    parts["scale"] += torch.tensor(0.06).log()
    parts["depth"][:, 0] -= 0.7  # the layers begin in front of and behind the centre
    parts["depth"][:, 1] += 0.7
    parts["rotation"][:, :, 0] = 1
    parts["color"] += (scene.reference.images[:, None] - 0.5) / 0.2821
    rates = {
        "depth": 0.03,
        "offset": 0.01,
        "opacity": 0.1,
        "scale": 0.02,
        "rotation": 0.01,
        "color": 0.03,
        "harmonics": 0.01,
    }
    groups = [{"params": [part.requires_grad_()], "lr": rates[name]} for name, part in parts.items()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, [rates[name] for name in parts], STEPS, pct_start=0.05)

    def draw(chosen):
        image = SplatterImage(torch.cat(list(parts.values()), dim=2), settings)
        gaussians = image.gaussians(scene.reference.cameras, scene.depth_range)
        return auto()(gaussians, views.cameras[:, chosen]).over(1.0)[0] * light[chosen]

    for _ in range(STEPS):
        chosen = 2 * torch.randperm(len(images) // 2)[:6]
        optimizer.zero_grad()
        (draw(chosen) - images[chosen]).square().mean().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        error = (draw(torch.arange(len(images))).clamp(0, 1) - images).square().mean((1, 2, 3))
    return torch.tensor([(-10 * part.log10()).mean() for part in (error[::2], error[1::2])])


scores = {}
test = [batch[scene : scene + 1] for batch in data.test_dataloader() for scene in range(len(batch.names))]
for scene in test[::6]:
    light = light_of(scene.all_views().images[0])
    for name, degree, factor in (
        ("one colour", 0, 1),
        ("one colour, light divided out", 0, light),
        ("degree 1", 1, 1),
        ("degree 2", 2, 1),
    ):
        scores.setdefault(name, []).append(fit(scene, degree, torch.ones_like(light) * factor))
        print(scene.names, name, scores[name][-1].tolist())
for name, values in scores.items():
    print(name, torch.stack(values).mean(0).tolist())
