"""Every file of `conf/` composes and instantiates; every experiment trains; ablations change what they say."""

import re
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import SMALL, call, compose_config

from completesplat.cli import VERBS
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers import RenderingConstants
from completesplat.settings.checks import check_image_size, check_parts_of_verb, check_values
from completesplat.settings.composition import compose, has_bfloat16
from completesplat.settings.options import conf_folder, options

CONF = conf_folder()


GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir())
TRAINING_GROUPS = [group for group in GROUPS if not group.endswith("_task")]


def test_nothing_in_the_tree_is_forgotten_here():
    assert {path.stem for path in CONF.glob("*.yaml")} == {*VERBS, "base"}
    assert set(GROUPS) == {*TRAINING_GROUPS, "data_task", "bench_task", "report_task"}
    assert all(compose_config(verb).out.startswith(f"outputs/{verb}/") for verb in VERBS if verb != "new")


# Options of other groups differ in one part of a run only, so that one configuration has one of each group.
DELTAS = ["experiment", "ablation", "posterior", "objective", "debug", "hparams_search"]
PARTS = [group for group in TRAINING_GROUPS if group not in DELTAS]
WHOLES = ["model", "evaluation"]


def complete(chosen: dict[str, str], *more: str):
    """Return a config with these options that passes the checks of `fit`; what it asks for (`???`) is given."""
    given = [f"{group}={option}" for group, option in chosen.items()]
    config = compose_config("fit", *given, *more, "out=/nowhere")
    for key in OmegaConf.missing_keys(config):
        OmegaConf.update(config, key, "x")
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    check_values("fit", config)
    check_parts_of_verb("fit", config)
    check_image_size(config)
    return config


@pytest.mark.parametrize(("group", "option"), [(group, option) for group in DELTAS for option in options(group)])
def test_every_option_that_changes_several_parts_composes_and_fits_the_checks(group, option):
    if option == "optuna":
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
    complete({group: option})


@pytest.mark.parametrize("number", range(max(len(options(group)) for group in PARTS)))
def test_every_option_of_a_part_composes_fits_the_checks_and_builds(number):
    """One config has an option of each part, those with fewer options in turn."""
    chosen = {group: options(group)[number % len(options(group))] for group in PARTS}
    config = complete(chosen, "data.image_size=64")  # which networks of all depths can halve
    for group in PARTS:
        if group not in WHOLES and number < len(options(group)):
            builds(config, group, options(group)[number])


def builds(config: Any, group: str, option: str) -> None:
    if group == "rasterizer":
        assert instantiate(config.rasterizer.constants) == RenderingConstants()
    if option in ("cuda", "gpu") and not torch.cuda.is_available():
        return
    if option == "mps" and not torch.backends.mps.is_available():
        return
    if group == "autoreconstructor":
        config.autoreconstructor.pretrained = None
    if (group, option) == ("loss", "stage2"):
        config.loss.terms.lpips = None  # its weights are not in the repository
    with torch.device("meta" if option.startswith("stable_diffusion") else "cpu"):
        made = instantiate(config[group], _convert_="all")
    assert made is not None
    if group in ("callbacks", "logger"):
        off = ["ema"] if (group, option) == ("callbacks", "default") else []
        assert [name for name, value in made.items() if value is None] == off
    elif group in ("optimizer", "schedule"):
        optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
        made(optimizer.param_groups[0]["params"]) if group == "optimizer" else made(optimizer, 100)


STARTS = {
    "var_stage1": "autoreconstructor.pretrained",
    "var_stage2": "model.checkpoint",
    "var_masked": "model.checkpoint",
    "diffusion": "model.autoreconstructor_checkpoint",
    "diffusion_masked": "model.checkpoint",
}


def test_an_experiment_asks_for_its_data_and_for_what_it_starts_from():
    kinds = [experiment.partition("_") for experiment in options("experiment")]
    for kind, stage in [(kind, stage) for kind, _, stage in kinds if kind in ("paper", "toy") and stage in STARTS]:
        config = compose_config("fit", f"experiment={kind}_{stage}")
        missing = OmegaConf.missing_keys(config.data) | OmegaConf.missing_keys(config.model)
        missing |= {f"model.{key}" for key, value in OmegaConf.to_container(config.model).items() if value == ""}
        assert missing == {STARTS[stage]} | (set() if kind == "toy" else {"data.root"})


def test_a_paper_experiment_draws_on_the_gpu_and_saves_by_the_clock():
    for experiment in [option for option in options("experiment") if option.startswith(("co3d_", "paper_"))]:
        config = compose_config("fit", f"experiment={experiment}")
        assert config.rasterizer._target_.endswith("selection.cuda")
        checkpoint = config.callbacks.checkpoint
        assert (checkpoint.every_n_train_steps, checkpoint.every_minutes) == (None, 30)
        if "small" not in experiment:  # the table that the test after training is for, and Inria's near plane
            assert config.evaluation.name == "co3d"
        assert config.rasterizer.constants.near_plane == 0.2
    elsewhere = compose_config("fit", f"experiment={experiment}", "rasterizer=tiled")
    assert instantiate(elsewhere.rasterizer) is not None


REALESTATE = ["data=realestate10k", "evaluation=realestate10k_128", "evaluation.data.evaluation_index=x"]
DATA = {"co3d": [], "realestate10k": REALESTATE}


@pytest.mark.parametrize("data", DATA)
def test_the_papers_stages(data):
    one, two = (complete({"experiment": f"paper_var_stage{n}"}, *DATA[data]) for n in (1, 2))
    lengths = [(c.trainer.get("max_epochs"), c.trainer.max_steps) for c in (one, two)]
    assert lengths == {"co3d": [(6000, -1), (8000, -1)], "realestate10k": [(None, 200_000), (None, 270_000)]}[data]
    assert [c.optimizer.lr for c in (one, two)] == [5e-5, 5e-6]
    reconstructor = one.autoreconstructor.reconstructor
    assert (reconstructor.parameterization.layers, reconstructor.skip_levels) == (2, [0])
    weights = [{name: term.weight for name, term in c.loss.terms.items() if term.weight} for c in (one, two)]
    assert weights[0] == {"mse": 0.8, "ssim": 0.2, "kl": 1e-6}
    assert weights[1] == weights[0] | {"lpips": 0.01}
    assert (one.data.batch_size, one.data.image_size) == (two.data.batch_size, two.data.image_size) == (32, 128)
    assert one.data.color_jitter == two.data.color_jitter is not None
    if data == "co3d":  # tested on sequences never seen, with all their frames
        assert (one.data.subset, one.data.allow_shared_sequences) == ("fewview_dev", False)
        assert (one.data.validation_targets, one.data.evaluation_targets) == (8, None)
    else:  # the second part goes on with the largest gap
        assert [(c.data.max_gap.first, c.data.max_gap.last) for c in (one, two)] == [(30, 150), (150, 150)]


@pytest.mark.parametrize("data", DATA)
def test_the_papers_diffusion(data):
    main, masked = (
        complete({"experiment": f"paper_{name}"}, *DATA[data]) for name in ("diffusion", "diffusion_masked")
    )
    assert [c.trainer.max_steps for c in (main, masked)] == [1_000_000, 100_000]
    for config in (main, masked):
        assert (config.optimizer.lr, config.data.batch_size, config.data.image_size) == (1e-4, 32, 128)
        assert (config.optimizer._target_, config.callbacks.ema.decay) == ("torch.optim.Adam", 0.9999)
        assert config.schedule._target_.endswith(".exponential")
        assert (config.schedule.warmup_steps, config.model.unconditional_probability) == (100, 0.2)
        names = [config[part]._target_.split(".")[-1] for part in ("conditioning", "denoiser")]
        assert names == ["StableDiffusionConditioning", "TextlessStableDiffusion"]
        assert config.autoreconstructor.encoder.channels == config.conditioning.channels == [128, 256, 512, 512]
        assert config.denoiser.latent_channels == config.denoiser.conditioning_channels == 4
        assert config.sampler.steps == 50
        # Latents are of images as they are, whether they are encoded once (data.latent_cache) or in every step.
        assert (config.data.color_jitter, config.data.latent_cache) == (None, None)
        assert (config.callbacks.checkpoint.keep_every, config.trainer.val_check_interval) == (50_000, 10_000)
    assert (main.data.box_masks, main.model.skip_weight) == (None, 1)
    assert (masked.data.box_masks.probability, masked.model.skip_weight) == (0.5, 1)  # as the paper's tables
    assert masked.model.autoreconstructor_checkpoint is None


ONE_IMAGE = ["posterior=image", "conditioning.channels=[8,8,16,16]"]  # as the pipeline's stage 1 with its four levels
TOYS = [option for option in options("experiment") if re.match("toy_(?!minis)", option)]  # see test_posterior_of_views


@pytest.mark.slow
@pytest.mark.parametrize("experiment", TOYS)
def test_every_toy_experiment_trains_on_one_batch(experiment, pipeline: Path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    settings = [f"data.root={pipeline.toy}", *SMALL, "trainer.max_steps=1"]
    var, diffusion = (run / "checkpoints/last.ckpt" for run in (pipeline.var, pipeline.diffusion))
    settings += {
        "toy_diffusion": [f"model.autoreconstructor_checkpoint={var}", "sampler.steps=2"],
        "toy_views_diffusion": [f"model.autoreconstructor_checkpoint={var}", "sampler.steps=2", *ONE_IMAGE],
        "toy_diffusion_masked": [f"model.checkpoint={diffusion}", "sampler.steps=2"],
        "toy_var_stage2": [f"model.checkpoint={var}", "ablation=no_lpips"],
        "toy_var_masked": [f"model.checkpoint={var}"],
    }.get(experiment, [])
    assert call(monkeypatch, "fit", f"experiment={experiment}", *settings, f"out={tmp_path / 'run'}") == 0
    assert (tmp_path / "run/checkpoints/last.ckpt").is_file()


# File below conf/: keys whose values a reproduction would find nowhere in the paper.
NOT_IN_THE_PAPER = {
    "autoreconstructor/stable_diffusion": "skip_dropout layer_depths smallest_scale",
    "callbacks/ema": "decay",
    "data/_scenes": "targets references_per_sequence color_jitter box_masks mask_threshold horizontal_flip",
    "data/co3d_category": "val_fraction depth_before evaluation_targets",
    "data/realestate10k": "max_gap near evaluation_targets",
    "evaluation/realestate10k_100": "data",
    "evaluation/images": "criterion precision",
    "experiment/_paper": "near_plane",
    "experiment/paper_diffusion": "decay color_jitter val_check_interval",
    "experiment/paper_diffusion_masked": "defaults box_masks",
    "loss/stage2": "term",
    "model/latent_diffusion": "background scale_batches",
    "model/preoptimized_vae": "vae normalization_batches opacity_weight kl_weight",
    "model/reconstructor_only": "background code_steps",
    "model/splatter_image": "background",
    "model/var": "background",
    "rasterizer/_constants": "near_plane",
    "sampler/_noise": "num_train_timesteps",
    "sampler/ddim50": "_target_",
    "schedule/exponential": "warmup_steps",
    "trainer/default": "gradient_clip_val limit_val_batches precision val_check_interval",
}


def is_marked(file: str, key: str) -> bool:
    """In the comment on its line, or right above."""
    lines = (CONF / f"{file}.yaml").read_text().splitlines()
    number = next(number for number, line in enumerate(lines) if line.strip().startswith(f"{key}:"))
    above = takewhile(lambda line: line.strip().startswith("#"), reversed(lines[:number]))
    message = " ".join([*above, lines[number].partition("#")[2]])
    return re.search("not state|states? neither|states? nothing", message) is not None


def test_what_the_paper_does_not_state_is_marked() -> None:
    places = [(file, key) for file, keys in NOT_IN_THE_PAPER.items() for key in keys.split()]
    assert [place for place in places if not is_marked(*place)] == []


ABLATIONS = options("ablation")
# Each ablation changes one of these; the first has everything that the paper's ablations take away.
ABLATED = ["toy_var", "toy_diffusion", "toy_diffusion_masked"]
NOWHERE = object()  # the value of a key that a config does not have


def composed(ablation: str, experiment: str = "toy_var") -> Any:
    return compose_config("fit", f"experiment={experiment}", f"ablation={ablation}")


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return a config's values by their keys; a list is a value."""
    if not isinstance(config, dict):
        return {prefix: config}
    values = {}
    for key, value in config.items():
        values |= flat(value, f"{prefix}.{key}".lstrip("."))
    return values


@cache
def settings(ablation: str, experiment: str) -> dict[str, Any]:
    """Return the values of an experiment, in which a part refers to the others and does not repeat them."""
    return flat(OmegaConf.to_container(composed(ablation, experiment)))


def written(ablation: str) -> set[str]:
    """Return the keys that an ablation's file sets."""
    return set(flat(OmegaConf.to_container(OmegaConf.load(CONF / f"ablation/{ablation}.yaml"))))


def changed(ablation: str, experiment: str) -> set[str]:
    """Return the keys whose values an ablation changes, those of a whole part that it takes away by the part's name."""
    full = settings("full", experiment)
    ablated = settings(ablation, experiment)
    differing = {key for key in full.keys() | ablated.keys() if full.get(key, NOWHERE) != ablated.get(key, NOWHERE)}
    away = {key for key in differing if ablated.get(key, NOWHERE) is None}
    return {key for key in differing if not any(key.startswith(f"{part}.") for part in away)}


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_an_ablation_changes_the_settings_in_its_file_and_nothing_else(ablation):
    assert written(ablation) in [changed(ablation, experiment) for experiment in ABLATED]


def built(ablation: str, part: str) -> Any:
    return instantiate(composed(ablation)[part], _convert_="all")


def test_a_device_has_bfloat16_if_it_computes_in_it_itself(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    assert [has_bfloat16(device) for device in ("cuda", "mps")] == [False, False]


@pytest.mark.parametrize(("verb", "override"), [("nosuch", "out=x"), ("fit", "~zz")])
def test_what_cannot_be_composed_is_an_error_of_ours(verb, override):
    with pytest.raises(CompleteSplatError, match=r"no verb 'nosuch'|zz"):
        compose(verb, override)


def test_what_is_taken_away_is_not_built():
    for name, skips, layers in (("full", 1, 2), ("no_skips", 0, 2), ("skips_first_two", 2, 2), ("m1", 1, 1)):
        reconstructor = built(name, "autoreconstructor").reconstructor
        assert len(reconstructor.skips) == skips
        assert reconstructor.network.conv_out.out_channels == 15 * layers
    for name, missing in (("full", set()), ("no_ssim", {"ssim"}), ("no_lpips", set()), ("no_variational", {"kl"})):
        assert set(built(name, "loss").terms) == {"mse", "ssim", "kl"} - missing
    assert built("full", "data").augmentation.color_jitter is not None
    assert built("no_color_aug", "data").augmentation.color_jitter is None


def test_without_variational_sampling_training_uses_the_mode():
    images = torch.rand(2, 3, 32, 32, generator=torch.manual_seed(0))
    for name, repeats in (("no_variational", True), ("full", False)):
        config = composed(name)
        config.autoreconstructor.skip_dropout = 0.0
        model = instantiate(config.autoreconstructor, _convert_="all").train()
        one, other = (model(images).splatter_image.raw for _ in range(2))
        assert torch.equal(one, other) == repeats
