"""ONNX graphs of weights beside torch: sizes, differences, and seconds of one CPU core for a sample.

OMP_NUM_THREADS=1 python notebooks/onnx_study.py [WEIGHTS ...]

Without names: all weights in the package. A photo of scikit-image is completed by both from one seed, with one thread
each, by turns.
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
import onnxruntime
import skimage
import torch
from onnx_predict import Pipeline, read_square

from completesplat import CompleteSplat
from completesplat.onnx_graphs import Precision
from completesplat.scene_model import SceneModel
from completesplat.weights import shipped

PHOTO = Path(skimage.__path__[0], "data", "coffee.png")
REPEATS = 3
PRECISIONS: tuple[Precision, ...] = ("float32", "float16")


class OneThread(Pipeline):
    """Pipeline whose graphs are computed by one thread."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        files = {name: folder / graph["file"] for name, graph in self.settings["graphs"].items()}
        self.sessions = {name: onnxruntime.InferenceSession(str(file), options) for name, file in files.items()}


def row(name: str, model: SceneModel, precision: Precision) -> str:
    """Return a row of the table."""
    photograph = model.read(PHOTO)
    image = read_square(PHOTO, model.image_size)
    settings = {"seed": 0, "bfloat16": False} if model.draws_samples else {}
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        model.to_onnx(Path(folder, "onnx"), precision)
        export = time.process_time() - start
        size = sum(file.stat().st_size for file in Path(folder, "onnx").glob("*.onnx")) / 1e6
        pipeline = OneThread(Path(folder, "onnx"))
        times: dict[str, list[float]] = {"torch": [], "onnx": []}
        for _ in range(REPEATS):
            start = time.process_time()
            scene = model(photograph, color_fits=0, detail=0, **settings)[0]
            times["torch"].append(time.process_time() - start)
            start = time.process_time()
            values = pipeline.scenes(image, photograph.fov_degrees, 1, 0)[0]
            times["onnx"].append(time.process_time() - start)
    extent = (scene.means.amax(0) - scene.means.amin(0)).max().item()
    means = np.abs(scene.means.numpy() - values["means"]).max() / extent
    colors = 255 * np.abs(scene.colors.numpy() - values["colors"]).max()
    seconds = f"{median(times['torch']):.2f} | {median(times['onnx']):.2f}"
    return f"| `{name}` | {precision} | {size:.1f} | {means:.1e} | {colors:.3f} | {seconds} | {export:.0f} |"


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    columns = (
        "weights",
        "stored in",
        "MB",
        "means differ, of the scene's size",
        "colours differ, of 255",
        "seconds a sample, torch",
        "onnxruntime",
        "seconds to export",
    )
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name in sys.argv[1:] or shipped():
        model = CompleteSplat.from_pretrained(name)
        for precision in PRECISIONS:
            print(row(name, model, precision), flush=True)


if __name__ == "__main__":
    main()
