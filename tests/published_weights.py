"""Files in the format of Splatter Image's published weights, with random values."""

import math
from pathlib import Path

import torch
from omegaconf import OmegaConf

# configs/default_config.yaml and configs/dataset/*.yaml of szymanowiczs/splatter-image, with small networks.
DATA = {
    "hydrants": {"znear": -2.0, "zfar": 2.0, "white_background": False, "origin_distances": True},
    "objaverse": {
        "fov": 49.134342641202636,
        **{"znear": 0.8, "zfar": 3.2, "white_background": True, "origin_distances": False},
    },
}
SMALL = {"base_dim": 16, "num_blocks": 2, "attention_resolutions": [8]}
LARGE = {"base_dim": 128, "num_blocks": 4, "attention_resolutions": [16]}


def config(name: str, size: int = 16, network: dict = SMALL) -> dict:
    model = {"name": "SingleUNet", "max_sh_degree": 1, "inverted_x": False, "inverted_y": True, "isotropic": False}
    model |= {"network_with_offset": True, "network_without_offset": False, "cross_view_attention": True, **network}
    data = {"training_resolution": size, "subset": -1, "input_images": 1, "category": name, **DATA[name]}
    embedding = {"embedding": None, "encode_embedding": None, "dimension": 0, "method": None}
    return {"wandb": {"project": "gs_pred"}, "data": data, "cam_embd": embedding, "model": model}


def shapes(size: int, network: dict) -> dict[str, list[int]]:
    """Names and sizes of upstream's tensors, counted anew."""
    found: dict[str, list[int]] = {}
    width, blocks = network["base_dim"], network["num_blocks"]

    def conv(name: str, inputs: int, outputs: int, kernel: int, resampled: bool = False) -> None:
        found[f"{name}.weight"], found[f"{name}.bias"] = [outputs, inputs, kernel, kernel], [outputs]
        if resampled:
            found[f"{name}.resample_filter"] = [1, 1, 2, 2]

    def norm(name: str, channels: int) -> None:
        found[f"{name}.weight"] = found[f"{name}.bias"] = [channels]

    def block(name: str, inputs: int, outputs: int, resampled: bool = False, attends: bool = False) -> None:
        norm(f"{name}.norm0", inputs)
        conv(f"{name}.conv0", inputs, outputs, 3, resampled)
        norm(f"{name}.norm1", outputs)
        conv(f"{name}.conv1", outputs, outputs, 3)
        if inputs != outputs or resampled:
            conv(f"{name}.skip", inputs, outputs, 1, resampled)
        if attends:
            norm(f"{name}.norm2", outputs)
            conv(f"{name}.qkv", outputs, 3 * outputs, 1)
            conv(f"{name}.proj", outputs, outputs, 1)

    net = "network_with_offset.encoder"
    sizes = [size, size // 2, size // 4, size // 8]
    widths, attending = [width, *[2 * width] * 3], [one in network["attention_resolutions"] for one in sizes]
    conv(f"{net}.enc.{size}x{size}_conv", 3, width, 3)
    channels, kept = width, [width]
    for one, outer, attends in zip(sizes, widths, attending, strict=True):
        if one < size:
            block(f"{net}.enc.{one}x{one}_down", channels, channels, resampled=True)
            kept.append(channels)
        for index in range(blocks):
            block(f"{net}.enc.{one}x{one}_block{index}", channels, outer, attends=attends)
            channels = outer
            kept.append(outer)
    for one, outer, attends in reversed(list(zip(sizes, widths, attending, strict=True))):
        if one == sizes[-1]:
            block(f"{net}.dec.{one}x{one}_in0", channels, channels, attends=True)
            block(f"{net}.dec.{one}x{one}_in1", channels, channels)
        else:
            block(f"{net}.dec.{one}x{one}_up", channels, channels, resampled=True)
        for index in range(blocks + 1):
            attended = attends and index == blocks
            block(f"{net}.dec.{one}x{one}_block{index}", channels + kept.pop(), outer, attends=attended)
            channels = outer
    norm(f"{net}.dec.{size}x{size}_aux_norm", width)
    conv(f"{net}.dec.{size}x{size}_aux_conv", width, 24, 3)
    conv("network_with_offset.out", 24, 24, 1)
    found["ray_dirs"] = [1, 3, size, size]
    return found | {key: [1, 3, 3] for key in ("v_to_sh_transform", "sh_to_v_transform")}


def tensors(name: str, size: int = 16, network: dict = SMALL) -> dict[str, torch.Tensor]:
    """Drawn in the order of their names, as for the outputs of upstream's network that are written in the tests."""
    generator, made = torch.Generator().manual_seed(0), {}
    for key, shape in sorted(shapes(size, network).items()):
        if key.endswith("resample_filter"):
            made[key] = torch.full(shape, 0.25)
        elif key.endswith((".weight", ".bias")):
            drawn = torch.randn(shape, generator=generator)
            fan_in = math.prod(shape[1:])
            made[key] = drawn / math.sqrt(fan_in) if len(shape) == 4 else 0.1 * drawn + key.endswith("weight")
    along = torch.arange(size) + 0.5 - size / 2
    y, x = torch.meshgrid(along, along, indexing="ij")
    fov = DATA[name].get("fov")
    focal = 1 if fov is None else size / 2 / math.tan(math.radians(fov) / 2)
    made["ray_dirs"] = torch.stack([x / focal, y / focal, torch.ones_like(x)])[None]
    made["v_to_sh_transform"] = torch.tensor([[[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]])
    return made | {"sh_to_v_transform": made["v_to_sh_transform"].mT.contiguous()}


def write_published(folder: Path, name: str, size: int = 16, settings: dict | None = None, **changed) -> Path:
    """`config_NAME.yaml` and the checkpoint beside it, some tensors changed (None: left out); the checkpoint's path."""
    folder.mkdir(parents=True, exist_ok=True)
    described = OmegaConf.merge(config(name, size), settings or {})
    OmegaConf.save(described, folder / f"config_{name}.yaml")
    state = {key: value for key, value in (tensors(name, size) | changed).items() if value is not None}
    path = folder / ("model_latest.pth" if name == "objaverse" else f"model_{name}.pth")
    optimizer = {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 5e-5, "betas": (0.9, 0.999)}]}
    checkpoint = {"iteration": 900000, "optimizer_state_dict": optimizer, "loss": 0.001, "best_PSNR": 20.0}
    torch.save({**checkpoint, "model_state_dict": state}, path)
    return path
