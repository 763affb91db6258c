"""Lightning's own trainer, checkpoints, callbacks and loggers, without our commands."""

import json
import re
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping, LearningRateFinder, ModelCheckpoint
from lightning.pytorch.tuner import Tuner
from scenes_for_training import opened, quiet_trainer, scene_batch
from torch.optim.lr_scheduler import LambdaLR

import completesplat
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.gaussians import Gaussians
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.training.stage import Stage
from completesplat.weights.checkpoint_reading import read_checkpoint

README = Path(__file__).parents[2] / "README.md"
CLASSES = {"var": completesplat.ReconstructionModule, "diffusion": completesplat.LatentDiffusion}


@pytest.mark.parametrize("stage", CLASSES)
def test_a_checkpoint_of_fit_loads_and_scores_as_fit_scored_it(pipeline, stage):
    run = getattr(pipeline, stage)
    model = CLASSES[stage].load_from_checkpoint(run / "checkpoints/last.ckpt", trust=True)
    weights = read_checkpoint(run / "checkpoints/last.ckpt")["state_dict"]
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
    data, _ = opened(pipeline.toy)
    (scores,) = quiet_trainer().test(model, data, verbose=False)
    of_fit = json.loads((run / "metrics.json").read_text())["test"]
    for predictor, place in {"model": "test", "mean_image": "test/mean_image"}.items():
        for region, view, metric in [("full", "novel", "psnr"), ("object", "reference", "ssim")]:
            assert scores[f"{place}/{region}/{view}/{metric}"] == pytest.approx(of_fit[predictor][region][view][metric])


def test_validation_and_prediction_are_lightnings_own(pipeline):
    model = CLASSES["var"].load_from_checkpoint(pipeline.var / "checkpoints/last.ckpt")
    data, _ = opened(pipeline.toy)
    trainer = quiet_trainer()
    (scores,) = trainer.validate(model, data, verbose=False)
    assert scores["val/psnr_novel"] > 0
    scenes = trainer.predict(model, data)
    assert all(isinstance(part, Gaussians) for part in scenes)
    assert sum(len(part.means) for part in scenes) == len(data.store("test").names)


def test_overfit_batches_trains_and_validates_on_the_same_scenes_in_all_epochs(toy_root):
    class Seen(Callback):
        def __init__(self):
            self.training = []
            self.validation = []

        def on_train_batch_start(self, trainer, model, batch, index):
            self.training.append(batch)

        def on_validation_batch_start(self, trainer, model, batch, index, loader=0):
            self.validation += batch.names

    seen, (data, model) = Seen(), opened(toy_root, "data.batch_size=1")
    quiet_trainer(overfit_batches=1, max_epochs=3, callbacks=[seen]).fit(model, data)
    assert len(seen.training) == 3
    assert len({name for batch in seen.training for name in batch.names}) == 1
    for batch in seen.training[1:]:
        assert torch.equal(batch.reference.images, seen.training[0].reference.images)
        assert torch.equal(batch.targets.images, seen.training[0].targets.images)
    assert len(set(seen.validation)) == 1


def test_a_checkpoint_is_held_to_the_rules_of_a_run(pipeline, tmp_path):
    path = pipeline.var / "checkpoints/last.ckpt"
    with pytest.raises(WeightsError, match="holds a ReconstructionModule, which is no LatentDiffusion"):
        completesplat.LatentDiffusion.load_from_checkpoint(path)
    contents = torch.load(path, weights_only=True)
    for target, match in [
        ("os.system", "names os.system, which is no part"),
        ("${oc.env:HOME}", "refers to something else"),
    ]:
        contents["hyper_parameters"]["model"]["loss"]["_target_"] = target
        torch.save(contents, tmp_path / "other.ckpt")
        with pytest.raises(WeightsError, match=match):
            completesplat.ReconstructionModule.load_from_checkpoint(tmp_path / "other.ckpt")
    del contents["hyper_parameters"]
    torch.save(contents, tmp_path / "other.ckpt")
    with pytest.raises(WeightsError, match="has no config"):
        completesplat.ReconstructionModule.load_from_checkpoint(tmp_path / "other.ckpt")


def saved(contents: dict, path: Path) -> Path:
    torch.save(contents, path)
    return path


def test_a_checkpoint_loads_with_changed_settings_which_its_next_checkpoint_keeps(pipeline, tmp_path):
    path = pipeline.var / "checkpoints/last.ckpt"
    load = completesplat.ReconstructionModule.load_from_checkpoint
    module = load(path, background=0.25, optimizer={"lr": 3e-4}, **{"loss.terms.ssim.weight": 0.5})
    assert module.background == 0.25
    assert module.optimizer.keywords["lr"] == 3e-4
    assert module.loss.terms["ssim"]["weight"] == 0.5
    before = load(path)
    assert before.optimizer.keywords["lr"] != 3e-4
    assert module.optimizer.keywords["adam_lr"] == before.optimizer.keywords["adam_lr"]
    assert module.loss.terms["mse"]["weight"] == before.loss.terms["mse"]["weight"]
    assert all(torch.equal(value, module.state_dict()[name]) for name, value in before.state_dict().items())

    data, _ = opened(pipeline.toy)
    trainer = quiet_trainer(max_steps=1, default_root_dir=tmp_path)
    trainer.fit(module, data)
    assert module.lr_schedulers().base_lrs[0] == 3e-4
    trainer.save_checkpoint(tmp_path / "next.ckpt")
    assert load(tmp_path / "next.ckpt", trust=True).background == 0.25

    diffusion = completesplat.LatentDiffusion.load_from_checkpoint(
        pipeline.diffusion / "checkpoints/last.ckpt", guidance_weight=0.5, **{"completesplat.sampler.steps": 3}
    )
    assert diffusion.guidance_weight == 0.5
    assert diffusion.completesplat.sampler.steps == 3


def test_a_changed_setting_that_does_not_fit_is_one_clear_line(pipeline):
    load = partial(completesplat.ReconstructionModule.load_from_checkpoint, pipeline.var / "checkpoints/last.ckpt")
    for given, match in [
        ({"backgruond": 0.25}, r"has no setting backgruond \(backgruond\); did you mean background"),
        ({"background": 2.0}, r"^background=2.0: must lie between 0 and 1$"),
        ({"optimizer": {"lrr": 1.0}}, r"has no setting lrr \(optimizer.lrr\)"),
        ({"optimizer": {"lr": -1.0}}, r"^optimizer.lr=-1.0: must be at least 0"),
        ({"loss": {"terms": {"lpips": {"weight": 1.0}}}}, r"^loss.terms.lpips: give weight, term"),
        (
            {"rasterizer": ReferenceRasterizer()},
            r"^rasterizer: cannot be overridden with ReferenceRasterizer; give num",
        ),
        ({"weights_only": False}, r"^weights_only=False: only tensors and plain values"),
    ]:
        with pytest.raises(CompleteSplatError, match=match) as caught:
            load(**given)
        assert "\n" not in str(caught.value)


def test_strict_false_takes_the_tensors_that_fit_and_names_the_others(pipeline, tmp_path, caplog):
    contents = torch.load(pipeline.var / "checkpoints/last.ckpt", weights_only=True)
    tensors = contents["state_dict"]
    name = next(name for name in tensors if name.endswith("weight"))
    kept = next(other for other in tensors if other != name)
    removed = tensors.pop(name)
    tensors["model.more"] = torch.zeros(2)
    other = saved(contents, tmp_path / "other.ckpt")
    load = completesplat.ReconstructionModule.load_from_checkpoint
    with pytest.raises(WeightsError, match=f"{name} is missing there"):
        load(other)
    module = load(other, strict=False)
    assert torch.equal(module.state_dict()[kept], tensors[kept])
    assert module.state_dict()[name].shape == removed.shape
    assert not torch.equal(module.state_dict()[name], removed)
    assert f"1 tensors are missing there and keep initial values: {name}" in caplog.text
    assert "1 tensors have no place here: model.more" in caplog.text
    tensors[name] = torch.zeros(3)
    with pytest.raises(WeightsError, match=rf"{name} is \[3\] there and "):
        load(saved(contents, tmp_path / "other.ckpt"), strict=False)


def test_hparams_file_stands_in_for_the_config_of_a_checkpoint_by_the_same_rules(pipeline, tmp_path):
    contents = torch.load(pipeline.var / "checkpoints/last.ckpt", weights_only=True)
    config = contents.pop("hyper_parameters")
    bare = saved(contents, tmp_path / "bare.ckpt")
    load = completesplat.ReconstructionModule.load_from_checkpoint
    module = load(bare, hparams_file=pipeline.var / "config.yaml")
    assert torch.equal(next(module.parameters()), next(load(pipeline.var / "checkpoints/last.ckpt").parameters()))
    stranger = tmp_path / "hparams.yaml"
    config["model"]["loss"]["_target_"] = "os.system"
    for text, match in [
        (json.dumps(config), "names os.system, which is no part"),
        ("lr: 1", "has no config; a run of fit writes one"),
        ("[", "not a run's configuration"),
    ]:
        stranger.write_text(text)
        with pytest.raises(WeightsError, match=match):
            load(bare, hparams_file=stranger)
    with pytest.raises(WeightsError, match=r"none.yaml: no such file"):
        load(bare, hparams_file=tmp_path / "none.yaml")


def test_an_override_that_does_not_fit_is_refused_as_on_the_command_line(toy_root):
    with pytest.raises(CompleteSplatError, match=r"(?s)Could not override 'optimzer\.lr'.*did you mean optimizer\.lr"):
        completesplat.compose("fit", "optimzer.lr=1")
    with pytest.raises(CompleteSplatError, match=r"data\.image_size=50: must be"):
        opened(toy_root, "data.image_size=50")
    with pytest.raises(CompleteSplatError, match=r"model.checkpoint is needed"):
        opened(toy_root, "experiment=toy_var_stage2")


class Quadratic(Stage):
    """One weight w with the loss (w - 3)^2, and a schedule that halves the rate."""

    def __init__(self) -> None:
        halved = partial(LambdaLR, lr_lambda=lambda step: 1.0 if step < 2 else 0.5)
        schedule = lambda optimizer, steps: halved(optimizer)  # noqa: E731
        super().__init__(ReferenceRasterizer(), partial(torch.optim.SGD, lr=1e-6), schedule)
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.rates: list[float] = []

    def reconstruct(self, scenes, seed):
        raise NotImplementedError

    def training_step(self, batch, index):
        self.rates.append(self.trainer.optimizers[0].param_groups[0]["lr"])
        return (self.weight - 3).square()


def test_lightnings_search_for_a_learning_rate_sets_that_of_the_optimizer_and_its_schedule(tmp_path):
    batches = torch.utils.data.DataLoader([scene_batch(1, size=8)] * 200, batch_size=None, collate_fn=lambda x: x)
    run = {"max_steps": 4, "default_root_dir": tmp_path}
    module = Quadratic()
    finder = LearningRateFinder(num_training_steps=40)
    quiet_trainer(callbacks=[finder], **run).fit(module, batches)
    found = finder.optimal_lr.suggestion()
    assert found > 1e-5
    assert module.lr == found
    assert module.rates[-4:] == pytest.approx([found, found, found / 2, found / 2])

    module = Quadratic()  # searched by itself before a run, in which the optimizer is built anew
    found = Tuner(quiet_trainer(**run)).lr_find(module, batches, num_training=40).suggestion()
    quiet_trainer(**run).fit(module, batches)
    assert module.rates[-4:] == pytest.approx([found, found, found / 2, found / 2])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_lines_of_the_readme_run_as_they_stand(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (lines,) = [block for block in blocks if "Trainer(" in block]
    assert len([line for line in lines.splitlines() if line.strip()]) <= 10
    assert command("data", "toy", "kind=objects", "scenes=20", "frames=8", "size=64", "out=DATA").status == 0
    names: dict = {}
    exec(lines, names)
    assert names["scores"]["test/full/novel/psnr"] > 5
    assert isinstance(names["model"], completesplat.ReconstructionModule)
    exec('from pathlib import Path\ntrainer.model.save_weights(Path("W"))', names)
    photo = next(tmp_path.glob("DATA/*/*/images/*.jpg"))
    assert command("predict", f"image={photo}", "weights=W", "steps=2", "video=[]", "out=P").status == 0


@pytest.mark.slow
def test_callbacks_and_loggers_of_lightning_see_the_figures(toy_root, tmp_path):
    from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

    data, model = opened(toy_root)
    best = ModelCheckpoint(tmp_path / "best", "{step}", monitor="val/psnr_novel", mode="max", save_top_k=2)
    # What must grow by 100 dB does not: it stops at the second validation after the first.
    stop = EarlyStopping("val/psnr_novel", min_delta=100.0, patience=1, mode="max")
    loggers = [CSVLogger(tmp_path, "csv")]
    if find_spec("tensorboard") or find_spec("tensorboardX"):
        loggers.append(TensorBoardLogger(tmp_path, "board"))
    settings = {"max_steps": 50, "val_check_interval": 1, "limit_val_batches": 1, "enable_checkpointing": True}
    trainer = quiet_trainer(callbacks=[best, stop], logger=loggers, **settings)
    trainer.fit(model, data)
    assert stop.stopped_epoch >= 0
    assert trainer.global_step < 50
    assert len(best.best_k_models) == 2
    assert float(best.best_model_score) == pytest.approx(max(map(float, best.best_k_models.values())))
    loaded = completesplat.ReconstructionModule.load_from_checkpoint(best.best_model_path)
    assert trainer.test(loaded, data, verbose=False)[0]["test/full/novel/psnr"] > 0
    assert "val/psnr_novel" in (tmp_path / "csv/version_0/metrics.csv").read_text()
