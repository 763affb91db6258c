"""The masked experiments as they are run, and what `predict` makes of their weights with each of its controls."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from plyfile import PlyData
from support import SMALL, call, strict_json

BOX, HIDDEN = "box=[0.5,0,1,1]", "mask.png"


@pytest.fixture(scope="module")
def runs(pipeline, tmp_path_factory) -> Path:
    """Folder of the runs `toy_var_masked` and `toy_diffusion_masked`, two steps each."""
    folder = tmp_path_factory.mktemp("masked")
    drawing = ["callbacks.pictures=null", "trainer.limit_val_batches=0", "test=false"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        for start, more in (("var", []), ("diffusion", ["sampler.steps=2", "callbacks.samples=null"])):
            checkpoint = getattr(pipeline, start) / "checkpoints/last.ckpt"
            given = [f"experiment=toy_{start}_masked", f"model.checkpoint={checkpoint}", f"data.root={pipeline.toy}"]
            assert call(monkeypatch, "fit", *given, *SMALL, *drawing, *more, f"out={folder / start}") == 0
    pixels = np.zeros((32, 32), np.uint8)
    pixels[:, 16:] = 255
    Image.fromarray(pixels).save(folder / HIDDEN)
    return folder


@pytest.fixture
def predict(command, pipeline, runs, tmp_path) -> Callable:
    """`completesplat predict` with the masked diffusion's weights: what the command left, the photograph's folder."""

    def run(name: str, *settings: str):
        given = [f"image={pipeline.photograph()}", f"weights={runs / 'diffusion/weights'}", "frames=2"]
        few = [] if any(setting.startswith("samples=") for setting in settings) else ["samples=2"]
        finished = command("predict", *given, *few, *settings, f"out={tmp_path / name}")
        return finished, tmp_path / name / pipeline.photograph().stem

    return run


def splats(folder: Path) -> list[bytes]:
    """The samples without the settings that their files record."""
    return [PlyData.read(path)["vertex"].data.tobytes() for path in sorted(folder.glob("*.ply"))]


@pytest.mark.parametrize("stage", ["var", "diffusion"])
def test_training_goes_on_from_the_first_weights(pipeline, runs, stage):
    """Two steps of Adam move no weight by more than about two learning rates."""
    paths = [folder / "checkpoints/last.ckpt" for folder in (getattr(pipeline, stage), runs / stage)]
    start, end = (torch.load(path, weights_only=True)["state_dict"] for path in paths)
    assert start.keys() == end.keys()
    moved = [(end[name] - value).abs().max().item() for name, value in start.items()]
    rate = OmegaConf.load(runs / stage / "config.yaml").optimizer.lr
    assert 0 < max(moved) < 2.1 * rate
    assert (runs / stage / "weights").exists() == (stage == "diffusion")


def test_the_masked_autoreconstructor_can_be_scored(command, runs, tmp_path):
    finished = command("test", f"ckpt={runs / 'var/checkpoints/last.ckpt'}", f"out={tmp_path / 'scores'}")
    assert finished.status == 0
    assert strict_json(tmp_path / "scores/metrics.json")


CONTROLS = {
    "skip_weight": ["skip_weight=0"],
    "guidance_weight": ["guidance_weight=0.5"],
    "sampler": ["sampler=dpm20", "steps=2"],
    "steps": ["steps=4"],
    "seed": ["seed=1"],
    "samples": ["samples=3"],
    "box": [BOX],
    "mask": [f"mask={HIDDEN}"],
}


@pytest.mark.slow
def test_each_control_writes_its_files_and_changes_the_scenes(predict, runs):
    made = {}
    for name, settings in {"none": [], **CONTROLS}.items():
        finished, folder = predict(name, *[setting.replace(HIDDEN, str(runs / HIDDEN)) for setting in settings])
        assert finished.status == 0, finished.err
        count = 3 if name == "samples" else 2
        numbers = [f"{i:02}" for i in range(count)]
        files = {"sheet.png", "scene.json", *(f"sample_{i}.ply" for i in numbers), *(f"orbit_{i}.mp4" for i in numbers)}
        assert {path.name for path in folder.iterdir()} == files
        made[name] = splats(folder)
        assert len(set(made[name])) == count
        recorded = strict_json(folder / "scene.json")["settings"]
        assert recorded["skip_weight"] == (0 if name in ("skip_weight", "box", "mask") else 1)
    assert made.pop("mask") == made["box"]
    del made["samples"]  # of which the first may be those that there are without
    # No two of the others have a scene in common.
    assert len({scene for scenes in made.values() for scene in scenes}) == sum(map(len, made.values()))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ([BOX, "skip_weight=0.5"], "skip_weight=0.5: must be 0 where the picture is hidden"),
        (["steps=7"], "steps=7: DDIM's must divide 1000"),
        (["mask=nowhere.png"], "nowhere.png: no such file"),
    ],
)
def test_a_control_out_of_its_range_is_refused_in_one_line(predict, settings, said):
    finished, folder = predict("out", *settings)
    assert finished.status == 2
    assert said in finished.err.splitlines()[-1]
    assert not folder.exists()
