"""Arguments behind a verb as Hydra reads them: tasks, files of any name, flags, and refusals."""

import os

import pytest
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.settings.arguments import FLAGS_WITH_VALUE, HYDRA_FLAGS, SHOWN_CONFIGS, for_hydra
from completesplat.settings.composition import compose

NAMES = ["a.jpg", "a,b.jpg", "[a].jpg", "{a:1}.jpg", "a=b.jpg", "seed=1.jpg", " (1) .jpg", "it's.jpg", '"a".jpg']
NAMES += ["a\\.jpg", "a\\", "a\\'.jpg", "é ü 写真.jpg", "a${seed}.jpg", "a\\${b.jpg", "$x.jpg", "new\nline.jpg"]
NAMES += ["~a.jpg", "null", "1", "+a.jpg", "#a.jpg", "a\ud800.jpg", os.fsdecode(b"\xff.jpg")]


def values(verb: str, *typed: str) -> dict[str, object]:
    """Return the settings that Hydra reads from arguments, by key."""
    parsed = OverridesParser.create().parse_overrides(for_hydra(verb, typed))
    config = OmegaConf.create({entry.key_or_group: entry.value() for entry in parsed} | {"seed": 3})
    return OmegaConf.to_container(config, resolve=True)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_any_name_is_the_image_or_the_path(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "\ud800" not in name:  # no file can have this name
        (tmp_path / name).touch()
    assert values("predict", name, "seed=3")["image"] == name
    assert values("predict", "seed=3", name, "b.jpg")["image"] == [name, "b.jpg"]
    assert values("view", name, "samples=2") == {"path": name, "samples": 2, "seed": 3}


@pytest.mark.parametrize(
    ("verb", "typed", "given"),
    [
        ("predict", ["a.png", "samples=1"], ["image='a.png'", "samples=1"]),
        ("predict", ["-m", "a.png", "seed=0,1"], ["-m", "image='a.png'", "seed=0,1"]),
        ("predict", ["--cfg", "job", "a.png"], ["--cfg=job", "image='a.png'"]),
        ("view", ["image=a.png", "weights=b"], ["image=a.png", "weights=b"]),
        ("fit", ["experiment=toy_var", "-m", "seed=0,1"], ["-m", "experiment=toy_var", "seed=0,1"]),
        ("fit", ["~callbacks"], ["~callbacks"]),
        ("data", ["-m", "toy", "seed=0,1"], ["-m", "data_task=toy", "seed=0,1"]),
        ("data", ["toy", "kind=rooms"], ["data_task=toy", "kind=rooms"]),
        ("data", ["import", "a b", "frames=3"], ["data_task=import", "folder='a b'", "frames=3"]),
        ("new", ["loss", "mine"], ["kind='loss'", "name='mine'"]),
        ("predict", ["--config-dir=b", "image=a.png"], ["--config-dir=b", "image=a.png"]),
    ],
)
def test_words_and_flags_become_settings(verb, typed, given):
    assert for_hydra(verb, typed) == given


@pytest.mark.parametrize(
    ("verb", "typed", "message"),
    [
        ("view", ["a.ply", "b.ply"], "give one path, not a.ply b.ply"),
        ("fit", ["--config-dir"], "--config-dir: lacks its value; give --config-dir VALUE"),
        ("fit", ["--cfg=a.png"], "--cfg=a.png: choose one of job, hydra, all"),
        ("new", ["loss", "a", "b"], "give one kind and one name, not loss a b"),
        ("predict", ["a.png", "-o", "b"], "-o: no flag; settings are key=value, such as out=DIR"),
        ("predict", ["a.png", "--samples", "4"], "--samples: no flag; settings are key=value, such as out=DIR"),
        ("fit", ["--seed=3"], "--seed=3: no flag; settings are key=value, such as out=DIR"),
        ("data", ["import", "a", "b"], "give one folder, not a b"),
    ],
)
def test_arguments_that_are_none_are_refused(verb, typed, message):
    with pytest.raises(CompleteSplatError) as caught:
        for_hydra(verb, typed)
    assert str(caught.value).startswith(message)


def test_the_flags_are_hydras():
    actions = {name: action for action in get_args_parser()._actions for name in action.option_strings}
    assert all(actions[name].nargs == 0 for name in HYDRA_FLAGS)
    assert all(actions[name].nargs is None for name in FLAGS_WITH_VALUE)
    assert tuple(actions["--cfg"].choices) == SHOWN_CONFIGS


@pytest.mark.parametrize("text", ["mine (files), at 3,000 steps", "1e3", "a's [b] ${c}", "true"])
def test_names_of_methods_and_notes_are_taken_literally(text):
    config = compose("test", f"method={text}", f"wandb.notes={text}")
    assert config.method == text
    assert config.wandb.notes == text


def test_a_name_in_quotes_or_null_is_what_hydra_reads():
    assert compose("test", "method='a b'").method == "a b"
    assert compose("test", "method=null").method is None
