"""The rasterizers that are compared, and which of them work here."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from completesplat.errors import CompleteSplatError
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.reports.rasterizers.timing import milliseconds
from completesplat.reports.rasterizers.workloads import splatter_scene

# `torch_tiled` and `gsplat_torch` are baselines: kept for this comparison, not to be chosen for training.
CLASSES = {
    "reference": "completesplat.rasterizers.reference.ReferenceRasterizer",
    "torch_tiled": "completesplat.reports.rasterizers.torch_tiled.TorchTiledRasterizer",
    "gsplat_torch": "completesplat.reports.rasterizers.gsplat_torch.GsplatTorchRasterizer",
    "tiled": "completesplat.rasterizers.tiled.TiledRasterizer",
    "cuda": "completesplat.rasterizers.cuda.CudaRasterizer",
}
MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel: the reference takes a second for a tenth of them


@dataclass(frozen=True)
class Backend:
    """A rasterizer, its name in the tables, and where it takes its tensors."""

    name: str
    rasterizer: Rasterizer

    @property
    def device(self) -> str:
        return "cuda" if self.name == "cuda" else "cpu"

    def takes(self, gaussians: int, pixels: int) -> bool:
        """Whether a workload with this many pixels in all views is not hopelessly large for it."""
        return self.name != "reference" or gaussians * pixels <= MOST_REFERENCE_PAIRS


def working_backends(names: Sequence[str], constants: RenderingConstants) -> tuple[list[Backend], dict[str, str]]:
    """Those of the named backends that render a small scene here, and for each of the others the reason why not.

    Raises:
        CompleteSplatError: a name that is not in `CLASSES`.
    """
    for name in names:
        if name not in CLASSES:
            raise CompleteSplatError(f"there is no backend {name!r} to time; there are {', '.join(CLASSES)}")
    backends, absent = [], {}
    for name in names:
        module, _, class_name = CLASSES[name].rpartition(".")
        try:
            backend = Backend(name, getattr(import_module(module), class_name)(constants))
            gaussians, cameras = splatter_scene(8, 1, "trained")
            milliseconds(backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))  # compiles
        except Exception as error:  # a broken installation may raise anything
            absent[name] = " ".join(str(error).split()) or type(error).__name__
        else:
            backends.append(backend)
    return backends, absent
