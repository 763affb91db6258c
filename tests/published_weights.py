"""Files in the format of Splatter Image's published weights, with random values."""

import math
from pathlib import Path

import torch
from omegaconf import OmegaConf

from completesplat.baselines.splatter_image.network import SongUNet

# configs/default_config.yaml and configs/dataset/*.yaml of szymanowiczs/splatter-image, with small networks.
DATA = {
    "hydrants": {"znear": -2.0, "zfar": 2.0, "white_background": False, "origin_distances": True},
    "cars": {
        "fov": 51.98948897809546,
        "znear": 0.8,
        "zfar": 1.8,
        "white_background": True,
        "origin_distances": False,
    },
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
    """Names and sizes of all tensors in a file of weights; `test_published` compares them with upstream's."""
    with torch.device("meta"):
        net = SongUNet(size, 3, 24, network["base_dim"], network["num_blocks"], network["attention_resolutions"])
    result = {f"network_with_offset.encoder.{name}": list(value.shape) for name, value in net.state_dict().items()}
    result |= {"network_with_offset.out.weight": [24, 24, 1, 1], "network_with_offset.out.bias": [24]}
    result["ray_dirs"] = [1, 3, size, size]
    return result | {key: [1, 3, 3] for key in ("v_to_sh_transform", "sh_to_v_transform")}


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
