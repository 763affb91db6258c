"""Ablations: what each changes at the paper's size, and jobs of ablations that change nothing."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from support import SMALL, compose_config, strict_json

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.commands import ablations
from completesplat.settings.options import conf_folder, options

QUICK = [*SMALL, "trainer.max_steps=1", "callbacks.images=null", "test=false"]
PAPER = ["experiment=paper_var_stage2", "data.root=/nowhere", "model.checkpoint=/nowhere"]
TERMS = {"mse", "ssim", "kl", "lpips"}
OF_A_LAYER = 15 * (9 * 128 + 1)  # the last convolution's weights and biases: 15 values of a Gaussian from 128 channels
FIRST_SKIP = 128 * 256 + 256  # a convolution of 1 x 1 from the first level's channels to the input of its block
SECOND_SKIP = 256 * 512 + 512
CHANGES: dict[str, tuple[int, set[str], dict[str, object]]] = {
    "no_skips": (-FIRST_SKIP, set(), {}),
    "skips_first_two": (SECOND_SKIP, set(), {}),
    "m1": (-OF_A_LAYER, set(), {}),
    "no_variational": (0, {"kl"}, {"autoreconstructor.variational": False}),
    "no_ssim": (0, {"ssim"}, {}),
    "no_lpips": (0, {"lpips"}, {}),
    "no_color_aug": (0, set(), {"data.color_jitter": None}),
}
"""By ablation: the difference in parameters, the loss terms that it removes, and other settings that it changes."""
IDLE: dict[str, set[str]] = {
    "paper_var_stage1": {"no_lpips"},
    "paper_var_stage2": set(),
    "toy_var": {"no_lpips"},
}
"""By experiment: the ablations that change nothing there."""
ABLATIONS = conf_folder() / "ablation"


def method(*ablation: str) -> tuple[int, set[str], dict[str, object]]:
    """Return parameters, loss terms and two further settings of the paper's stage 1."""
    config = compose_config("fit", *PAPER, *ablation)
    with torch.device("meta"):
        model: VariationalAutoReconstructor = instantiate(config.model.model, _convert_="all")
    terms = {str(name) for name, term in config.model.loss.terms.items() if term is not None}
    further = {
        "autoreconstructor.variational": model.variational,
        "data.color_jitter": config.data.color_jitter,
    }
    return sum(x.numel() for x in model.parameters()), terms, further


def test_at_the_papers_size_each_ablation_changes_what_the_supplement_says() -> None:
    parameters, terms, further = method()
    assert terms == TERMS
    assert further["autoreconstructor.variational"] is True
    assert further["data.color_jitter"] is not None
    assert method("ablation=full") == (parameters, terms, further)
    for ablation, (difference, removed, changed) in CHANGES.items():
        assert method(f"ablation={ablation}") == (parameters + difference, terms - removed, further | changed), ablation


def test_an_ablation_that_changes_nothing_says_so_and_can_be_left_out(command, toy_root: Path, caplog) -> None:
    sweep = ["fit", "-m", "experiment=toy_var", f"data.root={toy_root}", *QUICK, "out=S"]
    done = command.succeeds(*sweep, "ablation=no_lpips,full")
    assert "ablation=no_lpips: changes nothing here" in done.out + done.err + caplog.text
    records = {name: strict_json(Path(f"S/ablation-{name}/run.json")) for name in ("no_lpips", "full")}
    assert {name: record["unchanged"] for name, record in records.items()} == {"no_lpips": True, "full": False}
    done = command.succeeds(*sweep, "ablation=no_lpips", "seed=1,2", "skip_unchanged=true")
    assert done.out.count("left out; ablation=no_lpips: changes nothing here") == 2
    assert not list(Path("S").glob("*seed*/metrics.json"))


def with_ablation(config: DictConfig, ablation: str) -> DictConfig:
    """Return a config with the settings of an ablation, which `conf/fit.yaml` lists last. (Hydra takes 0.3 s.)"""
    changed = config.copy()
    parts: list[tuple[str, object]] = [("", OmegaConf.to_container(OmegaConf.load(ABLATIONS / f"{ablation}.yaml")))]
    while parts:
        place, value = parts.pop()
        if isinstance(value, dict):
            parts += [(f"{place}.{name}" if place else name, part) for name, part in value.items()]
        elif value is not None or OmegaConf.select(config, place) is not None:
            OmegaConf.update(changed, place, value, force_add=True)
    return changed


def trained_and_tested(config: DictConfig) -> list[object]:
    """Return the resolved settings of data, model and all else that Hydra makes objects of."""
    return [OmegaConf.to_container(config[part], resolve=True) for part in ("data", "model", "trainer", "callbacks")]


@pytest.mark.parametrize("experiment", options("experiment"))
def test_every_ablation_of_every_experiment_is_known_to_change_something_or_nothing(experiment, monkeypatch) -> None:
    config = compose_config("fit", f"experiment={experiment}", "data.root=/nowhere")
    plain = trained_and_tested(config)
    monkeypatch.setattr(ablations, "compose", lambda *_: config)
    monkeypatch.setattr(ablations, "take_architecture", lambda _: None)
    verdicts, listed = {}, {}
    for ablation in CHANGES:
        job = SimpleNamespace(choices={"ablation": ablation})
        given = SimpleNamespace(task=[f"experiment={experiment}", f"ablation={ablation}"])
        hydra_config = SimpleNamespace(runtime=job, overrides=given)
        monkeypatch.setattr(ablations, "HydraConfig", SimpleNamespace(get=lambda chosen=hydra_config: chosen))
        changed = with_ablation(config, ablation)
        verdicts[ablation] = ablations.idle_ablation(changed) is not None
        listed[ablation] = trained_and_tested(changed) == plain
    assert verdicts == listed
    idle = {ablation for ablation, nothing in listed.items() if nothing}
    if experiment in IDLE:
        assert idle == IDLE[experiment]


def test_settings_of_an_ablation_are_those_that_hydra_composes() -> None:
    given = ["experiment=toy_var", "data.root=/nowhere"]
    config = compose_config("fit", *given)
    for ablation in ("no_variational", "skips_first_two"):
        composed = compose_config("fit", *given, f"ablation={ablation}")
        assert trained_and_tested(with_ablation(config, ablation)) == trained_and_tested(composed)


@pytest.mark.parametrize("given", [["ablation=glob(zzz*)"], ["seed=range(0)"], ["ablation=full,m1", "data=glob(x*)"]])
def test_a_sweep_without_a_job_is_refused(given: list[str], command) -> None:
    reason = command.refuses("fit", "-m", "experiment=toy_var", *given, "out=S")
    assert "stands for no value, so there is no job" in reason
    assert ("no_lpips" in reason) == given[0].startswith("ablation=glob")
    assert not Path("S").exists()


def test_a_stage_that_diverges_ends_with_status_1_and_without_weights(command, toy_root: Path) -> None:
    given = ["experiment=toy_var", f"data.root={toy_root}", *QUICK, "trainer.max_steps=6", "optimizer.lr=1e30"]
    done = command("fit", *given, "optimizer.adam_lr=1e30", "out=RUN")
    assert (done.status, done.err.count("\n")) == (1, 1), done.err
    assert not list(Path("RUN").glob("weights*"))
    assert not Path("RUN/metrics.json").exists()
    assert not Path("RUN/checkpoints/last.ckpt").exists()
    assert "not finite" in strict_json(Path("RUN/run.json"))["diverged"]


def test_a_stage_whose_last_step_made_its_predictions_not_finite_has_no_weights(command, toy_root: Path) -> None:
    given = ["experiment=toy_var", f"data.root={toy_root}", *QUICK, "optimizer.lr=1e20", "optimizer.adam_lr=1e20"]
    done = command("fit", *given, "out=RUN")
    assert (done.status, done.err.count("\n")) == (1, 1), done.err
    assert "predictions are not finite" in done.err
    assert not list(Path("RUN").glob("weights*"))
    assert not Path("RUN/checkpoints/last.ckpt").exists()
    assert "predictions are not finite" in strict_json(Path("RUN/run.json"))["diverged"]


@pytest.mark.parametrize("name", ["1e3", "NAN", "true", "007"])
def test_folders_are_called_as_they_are_given(name: str, command) -> None:
    command.succeeds("data", "toy", "kind=objects", "scenes=1", "frames=2", "size=16", "workers=1", f"out={name}")
    assert [path.name for path in Path().iterdir()] == [name]
