"""Optimizer steps of both stages, and the rasterizer's share of a step of the reconstruction model."""

import statistics
from collections.abc import Mapping

from hydra.utils import instantiate

from completesplat.benchmarks.measuring import Row, milliseconds
from completesplat.benchmarks.workloads import Backend, rendering_milliseconds
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rendering
from completesplat.training.steps import Training, synthetic_batch

UNTIMED_STEPS, TIMED_STEPS = 3, 15
SLOW = {"gsplat_torch": (1, 3)}  # untimed and timed steps; the other slow backends would take minutes


def share(backend: Backend, model: Mapping[str, object], size: int, batch: int, targets: int, precision: str) -> Row:
    """Return medians over optimizer steps on one synthetic batch, on the CPU.

    The rasterizer's part is the time of both its passes for the Gaussians and cameras of the last step.

    Args:
        model: config of the module, without its rasterizer.
        size: side of the images in pixels.
        batch, targets: number of scenes in a batch, and of target views of each.
        precision: precision in Lightning's notation.
    """
    inputs: list[tuple[Gaussians, Cameras]] = []

    def rasterizer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
        inputs[:] = [(gaussians, cameras)]
        return backend.rasterizer(gaussians, cameras)

    scenes = synthetic_batch(size, batch, targets)
    training = Training(instantiate(model, rasterizer=rasterizer, _convert_="all"), precision)
    untimed, timed = SLOW.get(backend.name, (UNTIMED_STEPS, TIMED_STEPS))
    steps = [milliseconds(lambda: training.step(scenes)) for _ in range(untimed + timed)]
    step = statistics.median(steps[untimed:])
    rendering = statistics.median(rendering_milliseconds(backend.rasterizer, *inputs[0])[1] for _ in range(timed))
    return {
        "backend": backend.name,
        "size": size,
        "batch": batch,
        "views": 1 + targets,
        "step_ms": step,
        "rasterizer_ms": rendering,
        "share": rendering / step,
    }
