"""What people type behind a verb: pictures and paths of any name, settings, and what is none."""

import os

import pytest
from PIL import Image
from support import compose_config

from completesplat.errors import CompleteSplatError
from completesplat.settings.arguments import behind_dashes, for_hydra

NAMES = [
    "a.jpg",
    "a,b.jpg",
    "[a].jpg",
    "{a:1}.jpg",
    "a=b.jpg",
    "seed=1.jpg",
    "a b.jpg",
    " (1) .jpg",
    "it's.jpg",
    '"a".jpg',
]
NAMES += [
    "a\\.jpg",
    "a\\",
    "a\\'.jpg",
    "é ü 写真.jpg",
    "a${seed}.jpg",
    "a\\${b.jpg",
    "$x.jpg",
    "new\nline.jpg",
    "~a.jpg",
]
NAMES += ["null", "1", "+a.jpg", "#a.jpg", "a\ud800.jpg", os.fsdecode(b"\xff.jpg")]


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_any_name_is_the_picture_or_the_path(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "\ud800" not in name:  # no file's name; a missing one is named by what reads it
        (tmp_path / name).touch()
    assert compose_config("predict", *for_hydra("predict", [name, "seed=3"])).image == name
    assert list(compose_config("predict", *for_hydra("predict", ["seed=3", name, "b.jpg"])).image) == [name, "b.jpg"]
    assert compose_config("view", *for_hydra("view", [name, "--export", name])).path == name
    assert compose_config("view", *for_hydra("view", ["--export=" + name])).export == name


@pytest.mark.parametrize(
    "name", ["a,b.jpg", "[a].jpg", "[a,b].jpg", "a=b.jpg", "(1).jpg", "it's.jpg", "é.jpg", "{a.jpg"]
)
def test_a_setting_that_names_a_file_as_it_stands_is_that_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    assert compose_config("predict", *for_hydra("predict", [f"image={name}"])).image == name
    assert compose_config("test", *for_hydra("test", [f"ckpt={name}"])).ckpt == name


def test_numbers_and_lists_stay_what_they_are_beside_files_of_their_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("3", "null", "a.jpg", "b.jpg"):
        (tmp_path / name).touch()
    config = compose_config("predict", *for_hydra("predict", ["image=[a.jpg,b.jpg]", "seed=3", "mask=null"]))
    assert (list(config.image), config.seed, config.mask) == (["a.jpg", "b.jpg"], 3, None)


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
        ("new", ["loss", "mine"], ["kind='loss'", "name='mine'"]),
    ],
)
def test_words_and_flags_become_settings(verb, typed, given):
    assert for_hydra(verb, typed) == given


@pytest.mark.parametrize(
    ("verb", "typed", "said"),
    [
        ("predict", ["a.png", "image=b.png"], "give files by their names or as image=, not both: a.png"),
        ("view", ["a.ply", "b.ply"], "give one path, not a.ply b.ply"),
        ("view", ["a.ply", "--export"], "--export: lacks its value; give --export VALUE"),
        ("fit", ["--config-dir"], "--config-dir: lacks its value; give --config-dir VALUE"),
        ("new", ["loss", "a", "b"], "give one kind and one name, not loss a b"),
        ("fit", ["nonsense"], "nonsense: no setting, which are given as key=value"),
        ("data", ["toy", "rooms"], "rooms: no setting, which are given as key=value"),
        ("fit", ["out=a=b"], "out=a=b: cannot be read; a text with such characters wants quotes: \"out='a=b'\""),
        (
            "bench",
            ["settings=[a=b, c=[1,2]]"],
            "settings=[a=b, c=[1,2]]: cannot be read; a text with such characters wants quotes: "
            "\"settings=['a=b','c=[1,2]']\"",
        ),
        ("predict", ["image=a (1).png"], "image=a (1).png: cannot be read; a text with such characters wants quotes: "),
        ("fit", ["seed=0,1"], "seed=0,1: several values; -m makes a run of each, and a list is seed=[0,1]"),
    ],
)
def test_what_cannot_be_read_is_named_with_what_can(verb, typed, said):
    with pytest.raises(CompleteSplatError) as caught:
        for_hydra(verb, typed)
    assert str(caught.value).startswith(said)


def test_no_argument_behind_two_dashes_is_a_flag(command, tmp_path):
    assert behind_dashes(["-m", "a.png", "--", "-b.png", "c.png", "--", "-m"]) == [
        *("-m", "a.png", "./-b.png", "c.png", "./--", "./-m"),
    ]
    assert behind_dashes(["a.png", "-m"]) == ["a.png", "-m"]
    missing = command("predict", "weights=toy_objects", "rasterizer=reference", "out=OUT", "--", "-h")
    assert (missing.status, missing.err) == (2, "error: -h: no such file\n")


def test_pictures_are_given_by_their_names(command, tiny_weights, tmp_path):
    for name in ("a,[1].png", "seed=2.png"):
        Image.new("RGB", (32, 32), "red").save(tmp_path / name)
    quick = [f"weights={tiny_weights}", "samples=1", "steps=1", "video=[]", "rasterizer=reference", "out=OUT"]
    finished = command("predict", "a,[1].png", *quick, "seed=2.png")
    assert finished.status == 0, finished.err
    assert {path.parent.name for path in tmp_path.glob("OUT/*/sheet.png")} == {"a,[1]", "seed=2"}
    missing = command("predict", "nowhere,.png", *quick)
    assert (missing.status, missing.err.count("\n"), "nowhere,.png: no such file" in missing.err) == (2, 1, True)
