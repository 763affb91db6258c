"""Weights of a stranger: their configuration starts nothing, and gets no memory that their file does not have."""

import copy
import json
import math
import re
import shutil
import sys
from collections.abc import Iterator
from functools import reduce

import pytest
import torch
from support import compose_config

from completesplat.errors import WeightsError
from completesplat.generator import CompleteSplat, build
from completesplat.settings.schema import violations
from completesplat.splatter_image import Parameterization
from completesplat.weights import CONFIG_FILE, LARGEST_TEXT, SHIPPED, SUMS_FILE
from completesplat.weights.allowed import (
    SAMPLING_PARTS,
    ConfigOrigin,
    check_architecture,
    check_names,
    choices,
    class_of,
    listed_parts,
    names_for_weights,
    settings_of,
)

ENCODER = "autoreconstructor.encoder"
SCHEDULER = "sampler.scheduler"
SHIPPED_CONFIG = json.loads((SHIPPED / "toy_objects" / CONFIG_FILE).read_text())


@pytest.fixture
def folder(tiny_weights, tmp_path):
    """Weights that anyone may have changed."""
    shutil.copytree(tiny_weights, tmp_path / "weights")
    (tmp_path / "weights" / SUMS_FILE).unlink()
    return tmp_path / "weights"


def changed(architecture: dict, place: str, value: object) -> dict:
    """A copy with another value of a setting, which may be new."""
    architecture = copy.deepcopy(architecture)
    *parts, name = place.split(".")
    reduce(dict.__getitem__, parts, architecture)[name] = value
    return architecture


def change(folder, place: str, value: object) -> None:
    path = folder / CONFIG_FILE
    path.write_text(json.dumps(changed(json.loads(path.read_text()), place, value)))


def refusal(folder) -> str:
    with pytest.raises(WeightsError) as caught:
        CompleteSplat.from_pretrained(folder)
    return str(caught.value)


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A module that leaves a mark when it is imported, and a function that shows whether it was."""
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w')\nclass Trap: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield (tmp_path / "sprung").exists
    sys.modules.pop("trap", None)


TRAP = {"_target_": "trap.Trap"}
LOADER = {"_target_": "completesplat.generator.CompleteSplat.from_pretrained", "path": "x"}
NO_PART = "no part of models"
REFUSED = [
    (SCHEDULER, TRAP, f"names trap.Trap, which is {NO_PART}"),
    (SCHEDULER, {"_target_": "completesplat.diffusion.sampling.Sampler", "scheduler": TRAP}, NO_PART),
    (f"{ENCODER}.channels", [8, TRAP], NO_PART),
    (SCHEDULER, LOADER, NO_PART),
    (SCHEDULER, {"_target_": "os.system", "command": "true"}, f"names os.system, which is {NO_PART}"),
    ("denoiser._target_", "mine.Mine", f"names mine.Mine, which is {NO_PART} or data in this package; "),
    ("denoiser._target_", "\x1b[2J", r"names \x1b[2J, which is no part"),
    ("denoiser._target_", "${oc.env:HOME}", "${oc.env:HOME} refers to something else"),
    ("denoiser._target_", "Encoder", "encoder.Encoder, which is no part of a model; allowed are Denoiser, "),
    ("denoiser._target_", "torch.optim.Adam", "denoiser names torch.optim.Adam, which is no part of a model"),
    ("denoiser._target_", ["Denoiser"], "Denoiser'], which is no part of a model"),
    ("sampler._partial_", True, "sampler._partial_: there is no such setting, but scheduler, steps"),
    ("sampler.steps", "7", "sampler.steps=7: must be a whole number"),
    ("autoreconstructor.pretrained", "some/hub-id", "autoreconstructor.pretrained=some/hub-id: must be null"),
    ("image_size", 1_000_000, "image_size=1000000: must lie between 8 and 1024"),
    (f"{ENCODER}.channels", [10**9] * 4, "must lie between 1 and 8192"),
    (f"{ENCODER}.channels", 8, "must be a list"),
    (f"{ENCODER}.first_log_variance", math.inf, "must be finite"),
    (f"{SCHEDULER}.num_train_timesteps", 10**9, "must lie between 1 and 10000"),
    ("more", {}, "a model's settings are autoreconstructor, "),
    ("training", None, "training=None: must be a mapping"),
    ("training", {"picture_mean": [0.5] * 7}, "must have 8 entries"),
    # Larger than what the file of weights has.
    ("denoiser.channels", [2048] * 3, "denoiser.network.conv_in.weight"),
    (f"{ENCODER}.latent_channels", 8192, f"{ENCODER}.network.conv_out.weight"),
]


@pytest.mark.parametrize(("place", "value", "reason"), REFUSED)
def test_a_configuration_is_refused_in_one_line_and_nothing_it_names_is_imported(folder, trap, place, value, reason):
    change(folder, place, value)
    message = refusal(folder)
    assert not trap()
    assert "trap" not in sys.modules
    assert str(folder / CONFIG_FILE) in message or f"by {CONFIG_FILE}" in message
    assert reason in message
    assert message.isprintable()
    assert len(message) < 1000


def targets(part: dict) -> list[str]:
    inner = [name for value in part.values() if isinstance(value, dict) for name in targets(value)]
    return [part["_target_"], *inner] if "_target_" in part else inner


def test_weights_name_classes_by_name_and_their_paths_in_other_versions_count_too(folder):
    assert set(targets(json.loads((folder / CONFIG_FILE).read_text()))) <= set(names_for_weights())
    assert any("completesplat.autoreconstructor." in path for path in targets(SHIPPED_CONFIG))
    origin = ConfigOrigin(folder, folder, trust=False)
    for name, part in listed_parts().items():
        assert check_names({"_target_": name}, origin) == {"_target_": part.path}
    before = CompleteSplat.from_pretrained(folder)
    for place in ("denoiser", ENCODER, SCHEDULER):
        part = reduce(dict.__getitem__, place.split("."), before.architecture)
        change(folder, f"{place}._target_", f"completesplat.moved.elsewhere.{part['_target_']}")
    after = CompleteSplat.from_pretrained(folder)
    assert after.architecture == before.architecture
    assert all(torch.equal(value, after.state_dict()[name]) for name, value in before.state_dict().items())


def test_what_is_no_configuration_at_all_is_refused(folder):
    for text, reason in (
        ("", "not readable as JSON"),
        ("[" * 100_000, "not readable as JSON"),
        ('{"image_size": ' + "9" * 5000 + "}", "not readable as JSON"),
        ("[]", "a model's settings are"),
        ("{}", "a model's settings are"),
        (" " * LARGEST_TEXT + "{}", f"{LARGEST_TEXT} are plenty"),
    ):
        (folder / CONFIG_FILE).write_text(text)
        assert reason in refusal(folder)


HOLDER = """
class Holder:
    def __init__(self, network, **held):
        self.network, self.held = network, held
"""


def test_a_part_of_the_users_own_takes_plain_values_and_parts_in_any_place(tmp_path, monkeypatch):
    (tmp_path / "holder.py").write_text(HOLDER)
    monkeypatch.syspath_prepend(tmp_path)
    part = {"_target_": "holder.Holder", "network": 3, "held": [{"a": {"_target_": "Parameterization"}, "b": [None]}]}
    check_architecture({"network": part, "image_size": 32})
    built = build(part)
    held = built.held["held"][0]
    assert (type(built).__name__, built.network, held["b"]) == ("Holder", 3, [None])
    assert type(held["a"]) is Parameterization
    for name, value, reason in (
        ("first_depth", "x", "network.held.0.a.first_depth=x: must be a number"),
        ("_partial_", True, "network.held.0.a._partial_: there is no such setting"),
    ):
        with pytest.raises(WeightsError, match=re.escape(reason)):
            check_architecture(
                {"network": changed(part, "held", [{"a": part["held"][0]["a"] | {name: value}}]), "image_size": 32}
            )
    with pytest.raises(WeightsError, match=r"network\._partial_: weights cannot store this setting"):
        check_architecture({"network": part | {"_partial_": True}, "image_size": 32})
    sys.modules.pop("holder")


def settings(part: dict, place: str = "") -> Iterator[str]:
    for name, value in part.items():
        yield f"{place}{name}"
        if isinstance(value, dict):
            yield from settings(value, f"{place}{name}.")


ODD = (None, True, -1, 0, 10**400, 1e308, math.nan, "", "x", "${x}", [], [None], {}, {"_target_": "x"}, [[]])


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: str(odd)[:20])
def test_any_value_in_any_place_is_refused_as_weights_are_or_is_of_the_settings_kind(odd):
    accepted = []
    for place in settings(SHIPPED_CONFIG):
        try:
            check_architecture(changed(SHIPPED_CONFIG, place, odd))
            accepted.append(place)
        except WeightsError as error:
            assert len(str(error)) < 1000  # noqa: PT017
    assert not any("_target_" in place for place in accepted)
    if odd not in (None, True, 0, []) or odd is math.nan:
        signed = {"autoreconstructor.encoder.first_log_variance", "training.log_odds"}
        meant = signed if odd == -1 else {"training"} if odd == {} else set()
        meant |= {"training.content"} if isinstance(odd, str) else set()  # any text, which is only printed
        assert set(accepted) <= meant


def test_every_setting_of_every_class_is_checked():
    for part in names_for_weights():
        for name, hint in settings_of(class_of({"_target_": part})).items():
            assert choices(name) or violations(hint, object()), (part, name)


@pytest.mark.parametrize(
    "chosen",
    [
        ["autoreconstructor=stable_diffusion", "denoiser=stable_diffusion", "posterior=views"],
        ["autoreconstructor=minis", "conditioning=stable_diffusion", "posterior=views", "sampler=dpm20"],
        ["denoiser=stable_diffusion_no_text", "posterior=image", "objective=flow"],
        ["ablation=no_skips", "sampler=unipc10"],
    ],
)
def test_what_the_configuration_tree_offers_may_be_saved_and_loaded(chosen):
    config = compose_config("fit", "model=latent_diffusion", "autoreconstructor.pretrained=null", *chosen)
    config = config.model.completesplat
    check_architecture({name: config[name] for name in (*SAMPLING_PARTS, "image_size")})


def test_each_part_of_a_model_has_the_classes_that_the_configuration_tree_offers_for_it():
    """Whoever adds a denoiser with an option in `conf/` can store it."""
    assert {name: choices(name) for name in ("autoreconstructor", "network", "denoiser", "encoder")} == {
        "autoreconstructor": ["VariationalAutoReconstructor"],
        "network": ["SplatterImageUNet", "VariationalAutoReconstructor"],
        "denoiser": ["Denoiser", "TextlessStableDiffusion"],
        "encoder": ["Encoder"],
    }
    assert len(choices("scheduler")) == 4
    assert not choices("loss")
    assert not choices("data")
