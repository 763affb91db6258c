"""Gaussians of a capture: fitted to the training frames alone, written in the capture's axes, continued bit by bit."""

import pytest
import torch
from PIL import Image
from support import compose_config, interrupted_at, strict_json, write_capture

from completesplat.commands.fit import refuse_without_effect
from completesplat.data.captures.captured_frames import CapturedFrame
from completesplat.data.captures.module import CaptureDataModule
from completesplat.data.captures.transforms_json import read_transforms
from completesplat.errors import CompleteSplatError
from completesplat.export import fitted_scene
from completesplat.export.ply import read_ply
from completesplat.export.reading import read_gaussians
from completesplat.training.capture_fit import CaptureFit

FRAMES = 9
STEPS = 8
FITTING = {"initial": 200, "most": 260, "refine_every": 2}
QUICK = ["experiment=capture", "data.root=capture", "data.image_size=12", f"trainer.max_steps={STEPS}"]
QUICK += ["trainer.accelerator=cpu", "trainer.val_check_interval=100", "rasterizer=reference"]
QUICK += ["callbacks.progress=null", "callbacks.checkpoint.every_n_train_steps=4"]
QUICK += [f"model.fitting.{key}={value}" for key, value in FITTING.items()]
QUICK += ["model.formats=[splat,sog]", "model.frames=2"]


@pytest.fixture
def capture(tmp_path):
    write_capture(tmp_path / "capture", FRAMES)
    return tmp_path / "capture"


def no_converter() -> None:
    raise CompleteSplatError("no Node.js")


def test_held_out_frames_are_scored_and_not_fitted_and_a_run_continues(command, capture, tmp_path, monkeypatch):
    monkeypatch.setattr("completesplat.export.formats.find_splat_transform", no_converter)
    read = []
    original = CapturedFrame.read
    columns = []
    sheet = fitted_scene.image_sheet
    monkeypatch.setattr(fitted_scene, "image_sheet", lambda names, *rest: columns.append(names) or sheet(names, *rest))
    monkeypatch.setattr(CapturedFrame, "read", lambda self: read.append(self.number) or original(self))

    with interrupted_at(6, CaptureFit):
        assert command("fit", *QUICK, "out=parts").status != 0
    assert set(read) == set(range(FRAMES)) - {0, 4, 8}  # At least three of nine are held out, so every fourth is.
    assert command("fit", *QUICK, "ckpt_path=last", "out=parts").status == 0
    finished = command.succeeds("fit", *QUICK, "ckpt_path=last", "out=run")
    assert f"there is no checkpoint in {tmp_path / 'run'}, so the training begins" in finished.out
    held_out = [f"frame{number}.png" for number in (0, 4, 8)]
    rule = "one of 8 photos is held out, from the first on, and at least 3"
    fitted = f"6 of 9 photos; {rule}: {', '.join(held_out)}"
    assert f"fitted to {fitted}." in " ".join(finished.out.split())
    assert [finished.out.count(f"{split}: 1 sequence\n") for split in ("train", "val", "test")] == [1, 1, 1]
    assert "1 scene, 3 novel views" in finished.out
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"scene.ply", "scene.splat", "sheet.png", "orbit.mp4", "scene.json"} < files
    assert finished.out.count("left out: no Node.js") == 1
    assert columns[-1] == held_out
    metrics = strict_json(tmp_path / "run/metrics.json")
    assert metrics["test"]["protocol"]["fitted_to"] == fitted
    # One number for all held-out photos, the reference among them, which is no input of the model.
    model = metrics["test"]["model"]
    assert set(metrics["test"]) == {"protocol", "model", "mean_image"}
    assert (model["views"], set(model["full"])) == (3, {"novel"})
    assert set(model["photos"]["fitted"]) | set(held_out) == {f"frame{number}.png" for number in range(FRAMES)}
    assert model["photos"]["held_out"] == held_out
    below = f"{model['full']['novel']['psnr']:.2f} dB, the mean image "
    assert f"{below}{metrics['test']['mean_image']['full']['novel']['psnr']:.2f} dB: are these the" in finished.out
    assert metrics["train/gaussians"] == int(int(int(200 * 1.05) * 1.05) * 1.05)  # at steps 2, 4 and 6
    one, other = (torch.load(tmp_path / run / "checkpoints/last.ckpt", weights_only=True) for run in ("run", "parts"))
    assert all(tensor.equal(other["state_dict"][name]) for name, tensor in one["state_dict"].items())
    rates = [group["initial_lr"] for group in one["optimizer_states"][0]["param_groups"]]
    assert rates[1:] == pytest.approx([4 * 5e-3, 4 * 1e-3, 1 * 5e-2, 4 * 2.5e-3])  # opacities at 3DGS's own rate
    # The files are in the world and units of transforms.json.
    sequence = CaptureDataModule(str(capture)).source("test").read("capture")
    means = one["state_dict"]["raw.means"][:231] / sequence.scale + torch.tensor(sequence.origin)
    torch.testing.assert_close(read_ply(tmp_path / "run/scene.ply").means, means)
    splat = read_gaussians(tmp_path / "run/scene.splat").means  # sorted by importance
    torch.testing.assert_close(splat.sort(0).values, means.sort(0).values)
    scene = strict_json(tmp_path / "run/scene.json")
    frames = read_transforms(capture / "transforms.json").frames
    poses = torch.stack([torch.from_numpy(frame.world_to_camera).float() for frame in frames[::4]])
    camera = torch.tensor(scene["reference_camera"]["world_to_camera"])
    torch.testing.assert_close(camera, poses[0], atol=1e-5, rtol=1e-5)
    up = torch.nn.functional.normalize(-poses[:, 1, :3].mean(0), dim=0)  # of the held-out cameras
    torch.testing.assert_close(torch.tensor(scene["settings"]["up"]), up, atol=1e-5, rtol=1e-5)
    Image.open(tmp_path / "run/sheet.png").verify()
    # The folder of a run stands for its checkpoint; that of other Gaussians is refused.
    other = command.refuses("fit", *QUICK, "model.fitting.most=261", "ckpt_path=run", "out=other")
    assert other == "run/checkpoints/last.ckpt: of another model; give the settings of its run"
    # A test of a checkpoint writes no scene into the run.
    (tmp_path / "run/scene.ply").unlink()
    command.succeeds("test", "ckpt=run", "out=EVAL")
    assert not (tmp_path / "run/scene.ply").exists()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("optimizer.lr=1", "optimizer.lr=1: CaptureFit does nothing with it; leave it out"),
        ("data.horizontal_flip=true", "data.horizontal_flip: model=capture fits the photos as they are"),
        ("callbacks=ema", "callbacks=ema: the number of this model's weights changes"),
        ("data.root=.", "has 2 sequences (capture, other); model=capture fits one capture"),
    ],
)
def test_settings_without_effect_and_several_captures_are_refused(command, capture, tmp_path, change, reason):
    write_capture(tmp_path / "other", FRAMES)
    assert reason in command.refuses("fit", *QUICK, change)


def test_settings_of_a_sweep_may_be_without_effect_in_one_of_its_jobs(tmp_path):
    job = tmp_path / "sweep/x/0"
    config = compose_config("fit", "experiment=capture")
    job.mkdir(parents=True)
    (job / "run.json").write_text('{"overrides": ["optimizer.lr=1"]}')
    with pytest.raises(CompleteSplatError, match=r"optimizer\.lr=1: CaptureFit does nothing with it"):
        refuse_without_effect(config, job)
    (job / "run.json").write_text('{"overrides": ["optimizer.lr=1"], "sweep": {"folder": "../..", "job": 0}}')
    refuse_without_effect(config, job)


@pytest.mark.slow
def test_a_prepared_capture_has_lost_its_units_and_is_refused(command, capture):
    command.succeeds("data", "prepare", "data=capture", "data.root=capture", "data.image_size=12", "out=STORE")
    refused = command.refuses("fit", *QUICK, "data.root=STORE").replace(str(capture.parent), "")
    assert "data.root=STORE is prepared; model=capture fits one capture" in refused


def test_points_of_a_reconstruction_are_in_the_cameras_units(tmp_path):
    write_capture(tmp_path / "capture", FRAMES)
    points = [[0.5, 0.25, -0.125], [0, -0.5, 0], [1, 0, 0], [-1, 0, 0.5]]
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex 4\n{properties}end_header\n"
    (tmp_path / "capture/points.ply").write_text(header + "".join("{} {} {}\n".format(*point) for point in points))
    path = tmp_path / "capture/transforms.json"
    path.write_text(path.read_text().replace('{"camera', '{"ply_file_path": "points.ply", "camera'))
    sequence = CaptureDataModule(str(tmp_path / "capture"), image_size=12).source("train").read("capture")
    frame = read_transforms(path).frames[1].camera()
    origin = torch.tensor(sequence.origin, dtype=torch.float64)
    torch.testing.assert_close(sequence.points / sequence.scale + origin, torch.tensor(points).double())
    torch.testing.assert_close(sequence.cameras[0].centers / sequence.scale + origin, frame.centers)
