"""Weights in tests: the settings of data that they bring, and `weights=auto`."""

import pytest
from omegaconf import OmegaConf
from PIL import Image
from support import compose_config, strict_json, tiny_generator, write_capture

from completesplat.commands.trained import trained_model


@pytest.fixture
def weights(tmp_path):
    """Weights that were trained from 1 in front of an object's centre to 3 behind it."""
    model = tiny_generator()
    model.architecture["training"] = {"depth_before": 1.0, "depth_after": 3.0}
    model.save_pretrained(tmp_path / "weights")
    return str(tmp_path / "weights")


@pytest.fixture
def captures(tmp_path):
    """Two captures, both for the test."""
    for name in ("one", "two"):
        (tmp_path / "captures" / name).mkdir(parents=True)
        write_capture(tmp_path / "captures" / name, 6)
    return [
        "data=captures",
        f"data.root={tmp_path / 'captures'}",
        "data.test_fraction=1",
        "data.val_fraction=0",
        "data.workers=0",
    ]


def depths(weights, data, *typed):
    config = compose_config("test", *data, *typed)
    chosen = {name: config[name] for name in ("ckpt", "overrides", "seed", "trust", "rasterizer")}
    chosen["data"] = OmegaConf.to_container(config.data)
    chosen["typed"] = [setting.partition("=")[0] for setting in typed]
    data = trained_model(weights=weights, **chosen).configuration().data
    return data.get("depth_before"), data.get("depth_after"), data.image_size


def test_weights_bring_the_depths_of_their_training_and_typed_ones_win_with_a_line(weights, captures, caplog):
    assert depths(weights, captures) == (1, 3, 32)
    assert depths(weights, captures, "data.depth_after=3") == (1, 3, 32)
    assert depths(weights, ["data=realestate10k", "data.root=DATA"])[:2] == (None, None)
    assert caplog.messages == []
    assert depths(weights, captures, "data.depth_before=2") == (2, 3, 32)
    assert caplog.messages == ["data.depth_before=2: these weights were trained at 1.0"]
    caplog.clear()
    assert depths(weights, captures, "data.image_size=64") == (1, 3, 32)
    assert caplog.messages == ["data.image_size=64: these weights need 32, which is taken"]


def test_the_command_tells_typed_settings_from_the_defaults_of_data(command, tmp_path, weights, captures):
    given = [f"weights={weights}", "trainer.accelerator=cpu"]
    untyped = command.succeeds("test", *given, *captures, "out=UNTYPED")
    equal = command.succeeds("test", *given, *captures, "data.depth_before=1", "data.depth_after=3", "out=EQUAL")
    typed = command.succeeds("test", *given, *captures, "data.depth_before=2", "data.depth_after=2", "out=TYPED")
    scores = [strict_json(tmp_path / out / "metrics.json")["model"]["full"] for out in ("UNTYPED", "EQUAL", "TYPED")]
    assert scores[0] == scores[1] != scores[2]
    told = [(each.out + each.err).count("these weights were trained at") for each in (untyped, equal, typed)]
    assert told == [0, 0, 2]


def test_auto_takes_the_likeliest_weights_for_the_reference_views(command, tmp_path, captures, monkeypatch):
    for name in ("one", "two"):
        for number in range(6):
            Image.new("RGB", (16, 12), "white").save(tmp_path / "captures" / name / f"frame{number}.png")
    seen = []

    def likeliest(views, number):
        seen.append((views, number))
        return "toy_objects", "; so"

    monkeypatch.setattr("completesplat.commands.trained.likeliest_for", likeliest)
    finished = command.succeeds("test", "weights=auto", "trainer.accelerator=cpu", *captures, f"out={tmp_path / 'OUT'}")
    assert "weights: toy_objects; so\n" in finished.out
    ((views, number),) = seen
    assert ([name for name, _ in views], number) == (["one", "two"], 2)
    assert all((image == 255).all() for _, image in views)
    described = strict_json(tmp_path / "OUT/metrics.json")["protocol"]
    assert (described["checkpoint"]["path"], described["image_size"]) == ("toy_objects", 64)
