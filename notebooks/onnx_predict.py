"""Complete scenes from a photo by NumPy and onnxruntime alone, as a pattern for programs without torch.

completesplat export onnx weights=general out=ONNX
python notebooks/onnx_predict.py ONNX photo.jpg out --samples 4 --seed 0

The folder's `pipeline.json` says what the graphs need. The scenes equal those of
`completesplat predict image=photo.jpg weights=general color_fits=0 detail=0` before they are fitted. Pillow
reads the photo; its EXIF field of view is not used here.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
import onnxruntime
from PIL import Image, ImageOps

SH_C0 = 0.28209479177387814  # spherical harmonic of degree 0, by which 3DGS files divide colours
PLY = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
       "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip


class Pipeline:
    """Graphs of a folder, and what `pipeline.json` says of them."""

    def __init__(self, folder: Path) -> None:
        self.settings = json.loads((folder / "pipeline.json").read_text())
        files = {name: folder / graph["file"] for name, graph in self.settings["graphs"].items()}
        self.sessions = {name: onnxruntime.InferenceSession(str(file)) for name, file in files.items()}

    def run(self, name: str, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Run a graph, whose inputs and outputs have names."""
        outputs = self.settings["graphs"][name]["outputs"]
        return dict(zip(outputs, self.sessions[name].run(outputs, inputs), strict=True))

    def scenes(self, image: np.ndarray, fov_degrees: float, samples: int, seed: int) -> list[dict[str, np.ndarray]]:
        """Return the Gaussians of each sample for an image [3, size, size] in sRGB from 0 to 1."""
        settings = self.settings
        size = settings["image_size"]
        focal = size / 2 / math.tan(math.radians(fov_degrees) / 2)
        near, far = settings["depth_range"]
        if settings["depth_before"] is not None:  # the object stays as large in the photo as in training
            widths = [math.tan(math.radians(fov) / 2) for fov in (settings["fov_degrees"], fov_degrees)]
            moved = (near + settings["depth_before"]) * (widths[0] / widths[1] - 1)
            near, far = (max(depth + moved, settings["smallest_depth"]) for depth in (near, far))
        camera = {
            "intrinsics": np.float32([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]]),
            "depth_range": np.float32([[near, far]]),
        }
        if not settings["draws_samples"]:
            values = self.run("scene", {"image": image[None], **camera})
        else:
            values = self.sampled(image, camera, samples, seed)
        return [{name: value[i] for name, value in values.items()} for i in range(len(values["means"]))]

    def sampled(
        self, image: np.ndarray, camera: dict[str, np.ndarray], samples: int, seed: int
    ) -> dict[str, np.ndarray]:
        """Denoise latents, all samples at once, and decode them."""
        seen = self.run("image", {"image": image[None]})
        conditioning = np.repeat(seen.pop("conditioning"), samples, axis=0)  # zeros give the unconditional prediction
        terms = [torch_randn((samples, *self.settings["noise_shape"]), seed)]
        for call in self.settings["steps"]["calls"]:
            timestep = np.full(samples, call["timestep"], dtype=np.int64)
            inputs = {"latent": weighted(call["input"], terms), "timestep": timestep, "conditioning": conditioning}
            terms.append(self.run("step", inputs)["prediction"])
        latent = weighted(self.settings["steps"]["latent"], terms)
        return self.run("decode", {"latent": latent, "skip_weight": np.float32([1]), **camera, **seen})


def weighted(weights: list[float], terms: list[np.ndarray]) -> np.ndarray:
    """Return a weighted sum: each latent is one of the noise and of the predictions so far."""
    total = sum(weight * term.astype(np.float64) for weight, term in zip(weights, terms, strict=True))
    return np.asarray(total, dtype=np.float32)


def torch_randn(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Return what `torch.randn` draws on a CPU with a seed, for 16 numbers or a multiple of it.

    The Mersenne Twister's 24 lower bits become uniform numbers, and blocks of 16 of these normal ones (Box and Muller).
    """
    twister = np.random.RandomState(seed & 0xFFFFFFFF)
    bits = twister.randint(0, 2**32, size=math.prod(shape), dtype=np.uint32) & 0xFFFFFF
    uniform = (bits.astype(np.float32) / np.float32(2**24)).reshape(-1, 2, 8)
    radius = np.sqrt(-2 * np.log(1 - uniform[:, 0]))
    angle = np.float32(2 * math.pi) * uniform[:, 1]
    normal = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return normal.reshape(shape).astype(np.float32)


def read_square(path: Path, size: int) -> np.ndarray:
    """Return a photo as a square [3, size, size], whose border goes on where the photo is not square."""
    pixels = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    missing = [max(pixels.shape[:2]) - side for side in pixels.shape[:2]]
    widths = [(count // 2 + count % 2, count // 2) for count in missing]
    square = Image.fromarray(np.pad(pixels, [*widths, (0, 0)], mode="edge"))
    resized = np.asarray(square.resize((size, size), Image.Resampling.LANCZOS))
    return resized.transpose(2, 0, 1).astype(np.float32) / 255


def write_ply(path: Path, scene: dict[str, np.ndarray]) -> None:
    """Write Gaussians in the layout of 3D Gaussian Splatting (+x right, +y down, +z forward)."""
    opacity = np.clip(scene["opacities"].astype(np.float64), 1e-6, 1 - 1e-6)[:, None]
    columns = [
        scene["means"],
        np.zeros_like(scene["means"]),
        (scene["colors"] - 0.5) / SH_C0,
        np.log(opacity / (1 - opacity)),
        np.log(scene["scales"]),
        scene["quaternions"],
    ]
    table = np.concatenate(columns, axis=1).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in PLY)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + table.tobytes())


def main() -> None:
    """Write `sample_00.ply` and so on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what `completesplat export onnx` wrote")
    parser.add_argument("image", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fov", type=float, help="degrees across the square")
    arguments = parser.parse_args()
    pipeline = Pipeline(arguments.folder)
    settings = pipeline.settings
    image = read_square(arguments.image, settings["image_size"])
    fov = settings["fov_degrees"] if arguments.fov is None else arguments.fov
    arguments.out.mkdir(parents=True, exist_ok=True)
    for number, scene in enumerate(pipeline.scenes(image, fov, arguments.samples, arguments.seed)):
        write_ply(arguments.out / f"sample_{number:02d}.ply", scene)


if __name__ == "__main__":
    main()
