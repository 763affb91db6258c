"""Rewriting of the arguments behind a verb: files and paths of any name, settings, flags, and refusals."""

import os

import pytest
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.settings.arguments import ALONE, CHOICES, WITH_VALUE, behind_dashes, for_hydra

DASHES = "settings are key=value without dashes, such as out=DIR, and files are given by their names: `completesplat"
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
    assert values("view", name, "--export", name) == {"path": name, "export": name, "seed": 3}
    assert values("view", "--export=" + name)["export"] == name


def test_a_setting_that_names_an_existing_file_is_that_name_but_for_numbers_and_lists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a,b.jpg", "[a,b].jpg", "a=b.jpg", "(1).jpg", "it's.jpg", "é.jpg", "{a.jpg"):
        (tmp_path / name).touch()
        assert values("predict", f"image={name}")["image"] == name
    for name in ("3", "null", "a.jpg", "b.jpg"):
        (tmp_path / name).touch()
    settings = values("predict", "image=[a.jpg,b.jpg]", "samples=3", "mask=null")
    assert settings == {"image": ["a.jpg", "b.jpg"], "samples": 3, "mask": None, "seed": 3}


@pytest.mark.parametrize(
    ("verb", "typed", "given"),
    [
        ("predict", ["a.png", "samples=1"], ["image='a.png'", "samples=1"]),
        ("predict", ["-m", "a.png", "seed=0,1"], ["-m", "image='a.png'", "seed=0,1"]),
        ("predict", ["--cfg", "job", "a.png"], ["--cfg=job", "image='a.png'"]),
        ("view", ["image=a.png", "weights=b"], ["image=a.png", "weights=b"]),
        ("fit", ["experiment=toy_var", "-m", "seed=0,1"], ["-m", "experiment=toy_var", "seed=0,1"]),
        ("data", ["-m", "toy", "seed=0,1"], ["-m", "data_task=toy", "seed=0,1"]),
        ("view", ["--help"], ["--help"]),
        ("data", ["toy", "kind=rooms"], ["data_task=toy", "kind=rooms"]),
        ("data", ["import", "a b", "frames=3"], ["data_task=import", "folder='a b'", "frames=3"]),
        ("new", ["loss", "mine"], ["kind='loss'", "name='mine'"]),
        # As an agent of W&B's sweeps gives settings, unless its command has ${args_no_hyphens}.
        ("fit", ["--optimizer.lr=1", "-m", "--seed=0,1", "--test=0"], ["-m", "optimizer.lr=1", "seed=0,1", "test=0"]),
        ("predict", ["a.png", "out=größe 写"], ["image='a.png'", "out='größe 写'"]),
        ("predict", ["--image=a.png", "--config-dir=b"], ["--config-dir=b", "image=a.png"]),
    ],
)
def test_words_and_flags_become_settings(verb, typed, given):
    assert for_hydra(verb, typed) == given


@pytest.mark.parametrize(
    ("verb", "typed", "message"),
    [
        ("predict", ["a.png", "image=b.png"], "give files by their names or as image=, not both: a.png"),
        ("view", ["a.ply", "b.ply"], "give one path, not a.ply b.ply"),
        ("view", ["a.ply", "--export"], "--export: lacks its value; give --export VALUE"),
        ("fit", ["--config-dir"], "--config-dir: lacks its value; give --config-dir VALUE"),
        ("new", ["loss", "a", "b"], "give one kind and one name, not loss a b"),
        ("predict", ["-i", "a.png", "-o", "b"], f"-i a.png: {DASHES}"),
        ("predict", ["a.png", "-o", "b"], f"-o: {DASHES}"),
        ("fit", ["--output", "b"], f"--output: {DASHES}"),
        ("fit", ["-n=3"], f"-n=3: {DASHES}"),
        ("fit", ["nonsense"], "nonsense: no setting, which are given as key=value"),
        ("data", ["import", "a", "b"], "give one folder, not a b"),
        ("data", ["toy", "rooms"], "rooms: no setting, which are given as key=value"),
        ("fit", ["out=a=b"], "out=a=b: cannot be read; a text with such characters wants quotes: \"out='a=b'\""),
        (
            "test",
            ["overrides=a.b=c"],
            "overrides=a.b=c: cannot be read; a text with such characters wants quotes: \"overrides=['a.b=c']\"",
        ),
        (
            "test",
            ["overrides=[a.b=c]"],
            "overrides=[a.b=c]: cannot be read; a text with such characters wants quotes: \"overrides=['a.b=c']\"",
        ),
        ("bench", ["settings=[a=b,c]"], "settings=[a=b,c]: cannot be read; a text with such characters wants quotes"),
        ("predict", ["image=a (1).png"], "image=a (1).png: cannot be read; a text with such characters wants quotes: "),
        ("predict", ["a.png", "samples", "=", "8"], "=: settings are key=value, without spaces"),
        ("predict", ["a.png", "=3"], "=3: settings are key=value, without spaces"),
        ("fit", ["seed=0,1"], "seed=0,1: several values; -m makes a run of each, and a list is seed=[0,1]"),
    ],
)
def test_unreadable_arguments_are_refused_with_an_example(verb, typed, message):
    with pytest.raises(CompleteSplatError) as caught:
        for_hydra(verb, typed)
    assert str(caught.value).startswith(message)


def test_the_users_home_is_found_behind_an_equals_sign(monkeypatch):
    monkeypatch.setenv("HOME", "/homes/ann, bob")
    given = values("fit", "data.root=~/toys", "out=~/a,b")
    assert (given["data.root"], given["out"]) == ("/homes/ann, bob/toys", "/homes/ann, bob/a,b")


def test_no_argument_behind_two_dashes_is_a_flag():
    given = ["-m", "a.png", "--", "-b.png", "c.png", "--", "-m"]
    assert behind_dashes(given) == ["-m", "a.png", "./-b.png", "c.png", "./--", "./-m"]
    assert behind_dashes(["a.png", "-m"]) == ["a.png", "-m"]


def test_the_flags_are_hydras():
    actions = [action for action in get_args_parser()._actions if action.option_strings]
    assert {*ALONE, *WITH_VALUE} == {name for action in actions for name in action.option_strings}
    choices = {name: tuple(action.choices) for action in actions if action.choices for name in action.option_strings}
    assert choices == CHOICES
