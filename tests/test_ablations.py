"""Each ablation changes what it says, and nothing else."""

import re
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import compose_config

from completesplat.commands import conf_folder

ABLATIONS = sorted(path.stem for path in (conf_folder() / "ablation").glob("*.yaml"))
# What differs from the full model, in a run that has everything that can be taken away.
CHANGES = {
    "full": set(),
    "no_skips": {"autoreconstructor.reconstructor.skip_levels"},
    "skips_first_two": {"autoreconstructor.reconstructor.skip_levels"},
    "m1": {"autoreconstructor.reconstructor.parameterization.layers"},
    "no_variational": {"autoreconstructor.variational", "loss.terms.kl"},
    "no_ssim": {"loss.terms.ssim"},
    "no_lpips": {"loss.terms.lpips"},
    "no_color_aug": {"data.color_jitter"},
}


def composed(ablation: str) -> Any:
    return compose_config("fit", "experiment=toy_var", f"ablation={ablation}")


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Lists and None as values; so are the jitter and a whole term of the loss, which is there or not."""
    if not isinstance(config, dict) or re.fullmatch(r"loss\.terms\.\w+|data\.color_jitter", prefix):
        return {prefix: config}
    return {k: v for key, value in config.items() for k, v in flat(value, f"{prefix}.{key}".lstrip(".")).items()}


def parts(config: Any) -> dict[str, Any]:
    """Return the config groups that `model` refers to."""
    resolved = OmegaConf.to_container(config, resolve=True)
    return flat({name: resolved[name] for name in ("autoreconstructor", "loss", "data", "optimizer", "trainer")})


def built(ablation: str, part: str) -> Any:
    return instantiate(composed(ablation)[part], _convert_="all")


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_changes_its_own_settings_and_nothing_else(ablation):
    full, ablated = parts(composed("full")), parts(composed(ablation))
    if ablation == "no_lpips":
        full["loss.terms.lpips"] = "there"
    changed = {key for key in full.keys() | ablated.keys() if full.get(key) != ablated.get(key)}
    assert changed == CHANGES[ablation]


def test_what_is_taken_away_is_not_built():
    for name, skips, layers in (("full", 1, 2), ("no_skips", 0, 2), ("skips_first_two", 2, 2), ("m1", 1, 1)):
        reconstructor = built(name, "autoreconstructor").reconstructor
        assert len(reconstructor.skips) == skips
        assert reconstructor.network.conv_out.out_channels == 15 * layers
    for name, missing in (("full", set()), ("no_ssim", {"ssim"}), ("no_lpips", set()), ("no_variational", {"kl"})):
        assert set(built(name, "loss").terms) == {"mse", "ssim", "kl"} - missing
    assert built("full", "data").augment.keywords["color_jitter"] is not None
    assert built("no_color_aug", "data").augment.keywords["color_jitter"] is None


def test_without_variational_sampling_training_uses_the_mode():
    images = torch.rand(2, 3, 32, 32, generator=torch.manual_seed(0))
    for name, repeats in (("no_variational", True), ("full", False)):
        config = composed(name)
        config.autoreconstructor.skip_dropout = 0.0
        model = instantiate(config.autoreconstructor, _convert_="all").train()
        one, other = (model(images).splatter_image.raw for _ in range(2))
        assert torch.equal(one, other) == repeats
