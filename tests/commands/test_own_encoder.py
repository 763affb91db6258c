"""A user's own part of the networks: trained in both stages, written with the weights by its name, and read again."""

import shutil
import sys

import pytest
from readers import put
from support import SMALL, hub_snapshot, strict_json

from completesplat import CompleteSplat
from completesplat.errors import WeightsError
from completesplat.weights import CONFIG_FILE, SUMS_FILE

MYENC = """
from pathlib import Path

from completesplat.autoreconstructor.encoder import Encoder

Path(__file__).with_name("imported").touch()


class Enc(Encoder):
    def __init__(self, gain: float = 1.0, **settings):
        super().__init__(**settings)
        self.gain = gain

    def encode(self, values):
        return super().encode(self.gain * values)
"""
OWN = ["autoreconstructor.encoder._target_=myenc.Enc", "+autoreconstructor.encoder.gain=0.5"]
QUICK = [*SMALL, "callbacks.images=null", "test=false"]
DRAW = ["video=[]", "samples=1", "color_fits=1"]
REFUSAL = r"names myenc\.Enc, which is no part .* trust=true$"


@pytest.fixture
def runs(command, toy_root, built_once, tmp_path):
    """Both stages with the encoder of a module in the working folder, where the command runs."""
    folder = built_once("own_encoder", lambda folder: train(command, toy_root, tmp_path, folder))
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    forget()
    yield tmp_path
    forget()


def train(command, toy_root, place, folder):
    (place / "myenc.py").write_text(MYENC)
    fit = ["fit", f"data.root={toy_root}", *QUICK, *OWN]
    command.succeeds(*fit, "experiment=toy_var", "out=STAGE1")
    stage1 = "model.autoreconstructor_checkpoint=STAGE1/checkpoints/last.ckpt"
    command.succeeds(*fit, "experiment=toy_diffusion", stage1, "sampler.steps=2", "out=STAGE2")
    for name in ("myenc.py", "STAGE1", "STAGE2"):
        (shutil.copytree if (place / name).is_dir() else shutil.copy)(place / name, folder / name)


def forget():
    sys.modules.pop("myenc", None)


@pytest.fixture
def imported(runs, monkeypatch):
    """Whether the user's module, which Python finds from any folder, has been imported since the last call."""
    monkeypatch.syspath_prepend(runs)

    def imported() -> bool:
        mark, known = runs / "imported", "myenc" in sys.modules
        forget()
        marked = mark.exists()
        mark.unlink(missing_ok=True)
        return marked or known

    imported()
    return imported


def must_be_refused(weights, imported) -> None:
    with pytest.raises(WeightsError, match=REFUSAL):
        CompleteSplat.from_pretrained(weights)
    assert not imported()


@pytest.mark.parametrize("run", ["STAGE1", "STAGE2"])
def test_weights_with_a_part_of_the_users_own_draw_scenes_in_the_working_folder(command, runs, pipeline, run):
    written = strict_json(runs / run / "weights" / CONFIG_FILE)
    encoder = written.get("network", written.get("autoreconstructor"))["encoder"]
    assert (encoder["_target_"], encoder["gain"]) == ("myenc.Enc", 0.5)
    for weights in (run, f"{run}/weights", f"{run}/checkpoints/last.ckpt"):
        out = f"OUT/{weights.replace('/', '-')}"
        command.succeeds("predict", pipeline.photograph(), f"weights={weights}", *DRAW, f"out={out}")
        assert list((runs / out).glob("*/sample_00.ply"))


def test_from_elsewhere_a_part_of_the_users_own_needs_trust(command, runs, imported, pipeline, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    predict = ["predict", pipeline.photograph(), *DRAW, "out=OUT"]
    for weights in (runs / "STAGE2", runs / "STAGE2/weights", runs / "STAGE1/checkpoints/last.ckpt"):
        refused = command.refuses(*predict, f"weights={weights}")
        assert "names myenc.Enc, which is no part" in refused
        assert "trust=true" in refused
        must_be_refused(weights, imported)
        command.succeeds(*predict, f"weights={weights}", "trust=true")
        assert imported()


def test_a_run_that_somebody_works_in_is_not_the_users_own(runs, imported, monkeypatch):
    """Beside weights that were unpacked may lie modules that came with them."""
    for folder, weights in (("STAGE2", "weights"), ("STAGE2", "."), ("STAGE2/weights", ".")):
        monkeypatch.chdir(runs / folder)
        must_be_refused(weights, imported)


def test_what_the_hub_has_sent_is_not_the_users_own_even_below_the_working_folder(runs, imported, monkeypatch):
    place = hub_snapshot(monkeypatch, runs / "cache/hub", "some/splats")
    snapshot = shutil.copytree(runs / "STAGE2/weights", place)
    for weights in ("some/splats", snapshot):
        must_be_refused(weights, imported)
    assert CompleteSplat.from_pretrained("some/splats", trust=True).image_size == 32


@pytest.mark.parametrize("foreign", ["os.system", "torch.nn.Linear", "myenc.Path", "myenc.Encoder", "missing.Enc"])
def test_trust_allows_only_what_the_users_modules_define(runs, imported, foreign):
    weights = runs / "STAGE2/weights"
    (weights / SUMS_FILE).unlink()
    for settings in ({"_target_": foreign}, {"_target_": "myenc.Enc", "inner": [{"x": {"_target_": foreign}}]}):
        put(CONFIG_FILE, "autoreconstructor.encoder", settings)(weights)
        with pytest.raises(WeightsError, match=rf"names {foreign}, .* of your own, which lies in the working folder"):
            CompleteSplat.from_pretrained(weights, trust=True)


def test_view_refuses_weights_before_it_prints_its_address(command, runs, imported, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    monkeypatch.setattr("completesplat.commands.view.time", None)  # a page that opens would stay until it is ended
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for weights in (runs / "STAGE2", runs / "STAGE1/checkpoints/last.ckpt"):
        finished = command("view", weights, "out=OUT")
        assert (finished.status, finished.out) == (2, "")
        assert "names myenc.Enc, which is no part" in finished.err
        assert not imported()
