"""Models without training: they see the test's views, and say so; what is left of them in a Splatter Image."""

import pytest
from hydra.utils import instantiate
from scenes_for_training import quiet_trainer
from support import SMALL, compose_config, strict_json

from completesplat.evaluation import scorer

FEW = ["model.fitting.count=300", "model.fitting.steps=60", "data.evaluation_targets=3"]


def scored(model: str, root, *settings: str):
    config = compose_config("fit", "experiment=toy_var", f"model={model}", f"data.root={root}", *SMALL, *FEW, *settings)
    config.model.scenes_folder = None
    module, data = (instantiate(part, _convert_="all") for part in (config.model, config.data))
    quiet_trainer().test(module, datamodule=data, verbose=False)
    return module


def test_fitting_the_test_scenes_beats_not_fitting_them(toy_root):
    both = scored("per_scene", toy_root), scored("per_scene", toy_root, "model.fitting.steps=0")
    assert not list(both[0].parameters())
    fitted, unfitted = (m.evaluation.results()["model"]["full"]["novel"]["psnr"] for m in both)
    assert fitted > unfitted + 3


def test_seconds_are_medians_without_the_first_work_of_each_process(toy_root, monkeypatch):
    """Two processes, of which the first work took nine seconds each."""
    timed = lambda self, name, work, scenes: self.seconds[name].extend([9.0, 1.0, 2.0]) or work()  # noqa: E731
    monkeypatch.setattr(scorer.Scorer, "timed", timed)
    monkeypatch.setattr(scorer, "gather_values", lambda values: [values, values])
    seconds = scored("per_scene", toy_root, "model.fitting.steps=0").test_results()["model"]["seconds"]
    assert set(seconds.values()) == {1.5}


# 300 Gaussians fill at most 300 of the 1024 pixels; faint ones fill none.
@pytest.mark.parametrize(("opacity", "least", "most"), [(0.1, 1 - 300 / 1024, 0.999), (0.001, 1, 1)])
def test_a_splatter_image_of_few_gaussians_is_mostly_empty(toy_root, opacity, least, most):
    steps = 0 if opacity == 0.001 else 60
    module = scored("preoptimized", toy_root, f"model.fitting.opacity={opacity}", f"model.fitting.steps={steps}")
    assert least <= module.test_results()["model"]["empty_pixels"] <= most
    assert module.evaluation.results()["model"]["scenes"] == 1


def test_fit_goes_straight_to_the_test(command, toy_root, tmp_path):
    used = [setting for setting in SMALL if not setting.startswith(("trainer.max_", "trainer.val_check"))]
    settings = ["experiment=toy_var", "model=preoptimized", f"data.root={toy_root}", *used, *FEW]
    assert command("fit", *settings, "model.fitting.steps=3", f"out={tmp_path / 'run'}").status == 0
    metrics = strict_json(tmp_path / "run/metrics.json")
    assert metrics["steps"] == 0
    assert 0 < metrics["test"]["model"]["full"]["novel"]["psnr"] < 100
    assert 0 < metrics["test"]["model"]["empty_pixels"] <= 1


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ("test=False", "test=false: PerScene only fits the scenes of a test; leave it out"),
        ("optimizer.lr=1", "optimizer.lr=1: PerScene does nothing with it; leave it out"),
    ],
)
def test_a_fit_that_would_do_nothing_is_refused(command, toy_root, setting, reason):
    assert reason in command.refuses("fit", "experiment=toy_var", "model=per_scene", f"data.root={toy_root}", setting)
