"""Weights that come with the package, and published ones that some features load."""

from pathlib import Path
from urllib.parse import urlparse

import torch

from completesplat.errors import WeightsError
from completesplat.losses import vgg
from completesplat.metrics import inception
from completesplat.reports.doctor.finding import Finding, size
from completesplat.weights import BOX, CONFIG_FILE, SUMS_FILE, WEIGHTS_FILE, weights_folder

PART = "weights"
FILES = (CONFIG_FILE, WEIGHTS_FILE, SUMS_FILE)
PUBLISHED = [("LPIPS: VGG16", vgg.URL), ("FID, KID: Inception", inception.URL)]
VAE = "stabilityai/sd-vae-ft-mse"


def check(box: Path = BOX) -> list[Finding]:
    """Published weights that are not here are no error: they are fetched when they are needed.

    Args:
        box: holds the package's own, one folder for each model.
    """
    found = [_own(folder) for folder in sorted({path.parent for path in box.glob("*/*.*") if path.name in FILES})]
    if not found:
        said = "none come with this version: give predict weights=FOLDER, the `weights` that a run of stage 2 leaves"
        found = [Finding(PART, "in the package", "no", said)]
    return [*found, *(_published(name, url) for name, url in PUBLISHED), _vae()]


def _own(folder: Path) -> Finding:
    try:
        weights_folder(folder)
    except (OSError, WeightsError) as error:
        return Finding(PART, folder.name, "broken", f"{error}; install completesplat again")
    count = (folder / WEIGHTS_FILE).stat().st_size
    checked = "as it was written" if (folder / SUMS_FILE).is_file() else f"not checked, for there is no {SUMS_FILE}"
    return Finding(
        PART, folder.name, "yes", f"with the package, {size(count)}, {checked}: predict weights={folder.name}"
    )


def _published(name: str, url: str) -> Finding:
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name
    if path.is_file():
        return Finding(PART, name, "yes", f"{path}, {size(path.stat().st_size)}")
    return Finding(PART, name, "no", f"not here; will be downloaded from {url} when it is asked for")


def _vae() -> Finding:
    from huggingface_hub import try_to_load_from_cache

    name = "Stable Diffusion's VAE"
    path = try_to_load_from_cache(VAE, "diffusion_pytorch_model.safetensors")
    if isinstance(path, str):
        return Finding(PART, name, "yes", path)
    said = f"not here; will be downloaded from huggingface.co when autoreconstructor.pretrained={VAE} is given"
    return Finding(PART, name, "no", said)
