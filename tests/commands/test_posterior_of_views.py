"""`posterior=views` through both stages: training, cache, tests, predictions and reports."""

import math

import numpy as np
import pytest
from conftest import made
from plyfile import PlyData
from small_runs import rows
from support import SMALL, refused, strict_json, write_capture

LADDER = {"model", "posterior_mean", "posterior_samples", "mean_predictor", "true_sampler"}
ENCODER = [f"autoreconstructor.encoder.{setting}" for setting in ("channels=[8,16]", "norm_groups=4")]
SIZES = [*SMALL, "data.targets=2", *ENCODER]


@pytest.fixture(scope="module")
def runs(built_once):
    def train(folder):
        made(folder / "data", "data", "toy", "kind=minis", "scenes=4", "frames=8", "size=32", "workers=1")
        fit = ["fit", f"data.root={folder / 'data'}", *SIZES, "test=false"]
        made(folder / "var", *fit, "experiment=toy_minis_var")
        stage1 = f"model.autoreconstructor_checkpoint={folder / 'var/checkpoints/last.ckpt'}"
        stage2 = ["experiment=toy_minis_diffusion", stage1, "sampler.steps=2", "conditioning.channels=[8,16]"]
        made(folder / "diffusion", *fit, *stage2)

    return built_once("minis", train)


def column(run, name):
    return [float(row[name]) for row in rows(run) if row.get(name)]


def test_validation_logs_the_scores_of_a_perfect_second_stage(runs):
    assert column(runs / "var", "val/psnr_posterior")
    assert column(runs / "var", "val/psnr_novel")
    assert column(runs / "var", "val/posterior_gain")


def test_hidden_modes_have_every_rung_of_the_ladder(runs, command, tmp_path):
    settings = ["evaluation=hidden_modes", "evaluation.samples=2", "trainer.accelerator=cpu", "out=out"]
    command.succeeds("test", f"ckpt={runs / 'diffusion/checkpoints/last.ckpt'}", *settings)
    results = strict_json(tmp_path / "out/hidden_modes.json")
    assert set(results) == LADDER | {"reference_only"}
    # Of what all modes share the mean is certain; of the patch it is nobody.
    assert results["mean_predictor"]["energy_visible"] == pytest.approx(0, abs=0.02)
    assert results["mean_predictor"]["energy_hidden"] > 0.02


def test_the_ladder_of_reconstructions_has_every_rung_and_fitting_helps(runs, command, tmp_path):
    given = [f"ckpt={runs / 'diffusion/checkpoints/last.ckpt'}", "scenes=1", "samples=2", "fits=20"]
    given += ["overrides=['data.evaluation_targets=null']"]
    finished = command.succeeds("report", "ladder", *given, f"out={tmp_path}")
    results = strict_json(tmp_path / "ladder.json")
    assert results["settings"] == {"scenes": 1, "samples": 2, "seed": 0, "fits": 20}
    rows = {row.pop("rung"): row for row in results["rows"]}
    posterior, samples, alone = "posterior, all views", "samples", "reference alone"
    fitted = ["raw values fitted", "decoder fitted", "latent fitted"]
    assert list(rows) == [*fitted, posterior, samples, alone]
    for name in fitted:
        assert rows[name]["psnr"] > rows[posterior]["psnr"] + 0.05
    assert rows[fitted[0]]["psnr"] > rows[fitted[2]]["psnr"]
    assert rows[posterior]["psnr"] != rows[alone]["psnr"]
    assert all(row["sharpness_behind"] > 0 and 0 < row["behind"] < 60 for row in rows.values())
    assert all(row["sharpness_object"] > 0 for row in rows.values())
    assert any(row["sharpness_object"] != row["sharpness_behind"] for row in rows.values())
    assert "Where quality is lost" in finished.out
    assert finished.err.count(", done") == len(rows)  # a line each where there is no terminal


def test_several_samples_have_proper_scores_of_the_hidden_part(runs, command, tmp_path):
    settings = ["evaluation.scoring.samples=2", "trainer.accelerator=cpu", "out=out"]
    command.succeeds("test", f"ckpt={runs / 'diffusion/checkpoints/last.ckpt'}", *settings)
    results = strict_json(tmp_path / "out/metrics.json")
    for region in ("full", "hidden"):
        assert results["model"][region]["novel"]["energy"] > 0
        assert results["model"][region]["novel"]["crps"] > 0
        assert sum(results["mean_of_k"][f"ranks_{region}"]) == pytest.approx(1)


def test_the_cache_holds_latents_of_views_and_trains(runs, command, tmp_path):
    store, cache = tmp_path / "store", tmp_path / "cache"
    given = ["data=toy_minis", f"data.root={runs / 'data'}", "data.image_size=32", "data.evaluation_targets=2"]
    command.succeeds("data", "prepare", *given, "workers=1", f"out={store}")
    stage1 = runs / "var/checkpoints/last.ckpt"
    override = f"overrides=['data.root={store}']"
    command.succeeds("data", "latents", f"ckpt={stage1}", override, "views=3", f"out={cache}")
    assert strict_json(cache / "manifest.json")["origin"]["views"] == 3
    fit = ["fit", f"data.root={store}", *SIZES, "experiment=toy_minis_diffusion", "sampler.steps=2"]
    fit += [f"model.autoreconstructor_checkpoint={stage1}", "conditioning.channels=[8,16]", "test=false"]
    command.succeeds(*fit, f"data.latent_cache={cache}", "out=run")


def test_several_images_with_their_cameras_give_one_scene(runs, command, tmp_path):
    write_capture(tmp_path, 6)
    weights = [f"weights={runs / 'diffusion/weights'}", f"cameras={tmp_path / 'transforms.json'}"]
    weights += ["video=false", "color_fits=1"]

    def predict(*numbers: int) -> np.ndarray:
        images = ",".join(str(tmp_path / f"frame{number}.png") for number in numbers)
        out = tmp_path / "".join(map(str, numbers))
        assert command("predict", f"image=[{images}]", *weights, f"out={out}").status == 0
        assert strict_json(out / f"frame{numbers[0]}/scene.json")["settings"]["images"][0] == f"frame{numbers[0]}.png"
        (splats,) = out.rglob("*.ply")
        return np.stack([PlyData.read(splats)["vertex"][name] for name in ("z", "f_dc_0", "opacity")])

    first = predict(1, 2, 4)
    np.testing.assert_allclose(predict(1, 4, 2), first, atol=1e-4)
    assert np.abs(predict(1, 2, 3) - first).max() > 1e-3


def test_angles_around_the_object_are_cameras_that_look_at_it(runs, command, tmp_path):
    """The capture's cameras stand on a circle, each 60 degrees to the right of the one before."""
    write_capture(tmp_path, 6)
    images = ",".join(str(tmp_path / f"frame{number}.png") for number in (1, 2, 4))
    given = [f"image=[{images}]", f"weights={runs / 'diffusion/weights'}", "video=false"]
    angles = ["cameras=[60,120,240]", f"fov={math.degrees(0.7)}", "crop=center"]

    def predict(name: str, *settings: str) -> np.ndarray:
        command.succeeds("predict", *given, *settings, f"out={tmp_path / name}")
        (splats,) = (tmp_path / name).rglob("*.ply")
        return np.stack([PlyData.read(splats)["vertex"][name] for name in ("x", "y", "z", "f_dc_0", "opacity")])

    by_file = predict("file", f"cameras={tmp_path / 'transforms.json'}")
    np.testing.assert_allclose(predict("angles", *angles), by_file, atol=1e-3)
    assert np.abs(predict("left", "cameras=[-60,-120,-240]", *angles[1:]) - by_file).max() > 1e-2
    recorded = strict_json(tmp_path / "angles/frame1/scene.json")["settings"]
    assert recorded["cameras"] == [60, 120, 240]
    assert recorded["elevation"] == [0, 0, 0]
    assert recorded["distances"] == [1, 1, 1]


def test_images_that_cannot_be_taken_together_are_refused(runs, tiny_weights, tmp_path):
    write_capture(tmp_path, 6)
    one, two = (",".join(str(tmp_path / f"frame{number}.png") for number in range(count)) for count in (1, 2))
    for images, weights, box, message in (
        (one, runs / "diffusion/weights", "null", "two images or more"),
        (two, runs / "diffusion/weights", "[0,0,1,0.5]", "box does not go with cameras"),
        (two, tiny_weights, "null", "trained with posterior=image"),
    ):
        given = [f"image=[{images}]", f"cameras={tmp_path / 'transforms.json'}", f"weights={weights}", f"box={box}"]
        assert message in refused("predict", *given)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["cameras=[0,90,180]"], "cameras: 3 angles for 2 images"),
        (["cameras=[0,90]", "elevation=[10]"], "elevation: 1 elevation for 2 images"),
        (["cameras=[0,360]"], "two photos are from the same angle and elevation"),
        (["cameras=[0,90]", "elevation=90"], "elevation=90: must lie between -85 and 85"),
        (["cameras=[0,90]", "box=[0,0,1,0.5]"], "box does not go with cameras=[ANGLES]"),
        (["cameras=[0,left]"], "left"),
        (["cameras=transforms.json", "elevation=10"], "elevation does not go with cameras=FILE"),
        (["elevation=10"], "elevation goes with cameras=[ANGLES] only"),
        (
            ["cameras=nowhere.json"],
            "cameras=nowhere.json: no such file; give a transforms.json, or a list with the angle",
        ),
    ],
)
def test_angles_that_say_nothing_are_refused(runs, tmp_path, settings, message):
    write_capture(tmp_path, 6)
    images = ",".join(str(tmp_path / f"frame{number}.png") for number in (1, 2))
    assert message in refused("predict", f"image=[{images}]", f"weights={runs / 'diffusion/weights'}", *settings)


@pytest.mark.parametrize(
    ("experiment", "targets", "reason"),
    [("toy_minis_var", 1, "data.targets of 2 or more"), ("toy_minis_diffusion", 0, "set data.targets")],
)
def test_too_few_views_for_the_posterior_are_refused(runs, experiment, targets, reason, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    stage1 = f"model.autoreconstructor_checkpoint={runs / 'var/checkpoints/last.ckpt'}"
    second = [stage1, "conditioning.channels=[8,16]"] if "diffusion" in experiment else []
    given = [f"experiment={experiment}", f"data.root={runs / 'data'}", *SIZES, f"data.targets={targets}", *second]
    assert reason in refused("fit", *given)
