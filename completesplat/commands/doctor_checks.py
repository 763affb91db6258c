"""The checks of `completesplat doctor` that need other modules of the package: rasterizers and weights."""

import math
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlparse

import torch
from huggingface_hub import try_to_load_from_cache

from completesplat.commands.doctor import Finding, size
from completesplat.errors import WeightsError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses.lpips import URL as VGG_URL
from completesplat.metrics.image_sets import URL as INCEPTION_URL
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, TOLERANCE, failure
from completesplat.weights import CONFIG_FILE, SHIPPED, SUMS_FILE, WEIGHTS_FILE, check_folder

GOOD = "a test rendering is as it should be"
WEIGHTS_FILES = (CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE)
PUBLISHED = [("LPIPS: VGG16", VGG_URL), ("FID, KID: Inception", INCEPTION_URL)]
VAE = "CompVis/stable-diffusion-v1-4"


def check_rasterizers() -> Iterator[Finding]:
    """Yield the rasterizers, fastest first. Only the last one, which needs nothing but torch, must work."""
    faster = {name: failure(name, None) or wrong(make(None)) for name, make in FASTER.items()}
    for name, reason in faster.items():
        yield Finding(name, "no" if reason else "yes", reason or GOOD)
    reason = wrong(ReferenceRasterizer())
    message = f"{GOOD}; with nothing else, predictions are very slow" if all(faster.values()) else GOOD
    yield Finding("reference", "broken" if reason else "yes", reason or message)


@torch.no_grad()
def wrong(rasterizer: Rasterizer) -> str | None:
    """Render two round Gaussians, one behind the other on the optical axis; return what is wrong, None if nothing is.

    With focal length f, a Gaussian of scale s at depth z is a disc of variance (f s / z)^2 plus the blur, in px^2. Its
    alpha is its opacity at the center, and exp(-1 / (2 variance)) times that one pixel aside. The front one is
    composited over the other (gsplat's conventions, see `completesplat.rasterizers`).
    """
    focal, depths, sizes, opacities = 40.0, (2.0, 4.0), (0.1, 0.4), (0.8, 0.5)
    colors = torch.tensor([[0.9, 0.5, 0.1], [0.2, 0.4, 1.0]])
    means = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    scales, upright = torch.tensor(sizes)[:, None].expand(2, 3), torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    intrinsics = torch.tensor([[focal, 0, 2.5], [0, focal, 2.5], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], intrinsics[None, None], (5, 5))
    drawn = rasterizer(Gaussians(means, upright, scales, torch.tensor(opacities), colors)[None], cameras).color[0, 0]
    variances = [(focal * s / z) ** 2 + RenderingConstants().blur for s, z in zip(sizes, depths, strict=True)]
    for aside in (0, 1):
        front, back = (o * math.exp(-(aside**2) / (2 * v)) for o, v in zip(opacities, variances, strict=True))
        true = front * colors[0] + (1 - front) * back * colors[1]
        difference = (drawn[:, 2, 2 + aside] - true).abs().max().item()
        if not difference <= TOLERANCE:  # NaN is wrong too
            return f"its test rendering is wrong by {difference:.2g}"
    return None


def check_weights(box: Path = SHIPPED) -> Iterator[Finding]:
    """Yield the package's weights, in folders of `box`, and published ones, which are downloaded if missing."""
    folders = sorted({path.parent for path in box.glob("*/*.*") if path.name in WEIGHTS_FILES})
    yield from map(_own, folders)
    if not folders:
        message = "none come with this version: give predict weights=FOLDER, the `weights` that a run of stage 2 leaves"
        yield Finding("in the package", "no", message)
    for name, url in PUBLISHED:
        path = Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name
        yield _published(name, path if path.is_file() else None, f"from {url} when it is asked for")
    vae = try_to_load_from_cache(VAE, "diffusion_pytorch_model.safetensors")
    when = f"from huggingface.co when autoreconstructor.pretrained={VAE} is given"
    yield _published("Stable Diffusion's VAE", vae if isinstance(vae, str) else None, when)


def _own(folder: Path) -> Finding:
    try:
        check_folder(folder)
    except (OSError, WeightsError) as error:
        return Finding(folder.name, "broken", f"{error}; install completesplat again")
    count = (folder / WEIGHTS_FILE).stat().st_size
    checked = "as it was written" if (folder / SUMS_FILE).is_file() else f"not checked, for there is no {SUMS_FILE}"
    return Finding(folder.name, "yes", f"with the package, {size(count)}, {checked}: predict weights={folder.name}")


def _published(name: str, path: Path | str | None, where: str) -> Finding:
    if path is None:
        return Finding(name, "no", f"not here; will be downloaded {where}")
    return Finding(name, "yes", f"{path}, {size(Path(path).stat().st_size)}")
