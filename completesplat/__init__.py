"""Complete Gaussian splats from a single image with latent diffusion.

model = completesplat.CompleteSplat.for_photo("photo.jpg")
scenes = model("photo.jpg", samples=4, seed=0)
completesplat.write_ply("scene.ply", scenes[0])
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from completesplat.export.ply import read_ply as read_ply
    from completesplat.export.ply import write_ply as write_ply
    from completesplat.gaussians import Gaussians as Gaussians
    from completesplat.generator import CompleteSplat as CompleteSplat
    from completesplat.version import __version__ as __version__

# By default, threads of torch's GNU OpenMP spin for milliseconds while they wait for the next of hundreds of small
# parallel regions. Beside another busy process they take the cores from the threads that they wait for. Without
# spinning, regions begin late on free cores. torch reads this when it is loaded; what a user has set stays.
if "torch" not in sys.modules:
    os.environ.setdefault("GOMP_SPINCOUNT", "1500")

_PLACES = {
    "CompleteSplat": "generator",
    "Gaussians": "gaussians",
    "LatentDiffusion": "training.latent_diffusion",
    "ReconstructionModule": "training.reconstruction",
    "__version__": "version",
    "compose": "settings.composition",
    "instantiate": "commands.fit",
    "read_ply": "export.ply",
    "write_ply": "export.ply",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that importing the package does not import torch."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
