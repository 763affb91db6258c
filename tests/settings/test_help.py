"""`VERB --help`: each setting with its comment, its kind and choices, in lines that fit."""

import re

import pytest

from completesplat.cli import VERBS
from completesplat.errors import CompleteSplatError
from completesplat.settings import options as conf
from completesplat.settings.help import WIDTH, help_page

SOME_TASKS = (None, "check", "summary", "controls")
WITH_TASKS = [
    (verb, task) for verb in VERBS for task in (conf.options(f"{verb}_task") if verb in conf.TASKS else [None])
]


@pytest.mark.parametrize(("verb", "task"), WITH_TASKS)
def test_each_own_setting_is_explained_in_conf(verb, task):
    places = {choice.place.partition(".")[0] for choice in conf.choices_of_verb(verb, task)} | {"stage1", "stage2"}
    settings = [setting for setting in conf.settings_of_verb(verb, task) if setting.key.partition(".")[0] not in places]
    assert settings[0].key == ("kind" if verb == "new" else "out")  # `new` writes into the working folder
    unexplained = [setting.key for setting in settings if not setting.comment and "." not in setting.key]
    assert unexplained == []


@pytest.mark.parametrize(("verb", "task"), [one for one in WITH_TASKS if one[1] in SOME_TASKS])
def test_a_page_has_examples_settings_and_parts_and_fits(verb, task):
    text = help_page(verb, [task] if task else [])
    assert text.startswith(f"completesplat {verb}: ")
    assert max(map(len, text.splitlines())) <= WIDTH
    assert "Examples:\n  completesplat " in text
    for setting in conf.settings_of_verb(verb, task):
        assert re.search(rf"^  {re.escape(setting.key)}(=| |$)", text, re.MULTILINE), setting.key
    for choice in conf.choices_of_verb(verb, task):
        assert re.search(rf"^  {re.escape(choice.place)}(=| |$)", text, re.MULTILINE), choice
    assert "_target_" not in text


def test_kinds_ranges_and_choices_are_shown():
    text = " ".join(help_page("predict", []).split())
    assert "samples=4 Number of samples of each photo. [whole number, 1 to 1000]" in text
    assert "[number, 0 to 1 or null]" in text
    assert "image needed; A photo" in text
    assert "rasterizer=auto what draws Gaussians [auto, cuda, reference, tiled]" in text
    assert "_global_" not in help_page("bench", ["rasterizers"])  # its constants have no name to choose them by


def test_a_part_shows_its_settings_with_the_docstring_of_its_class():
    text = " ".join(help_page("fit", ["data=co3d_hydrants"]).split())
    assert "data.evaluation_batch_size=4 scenes of an evaluation batch; 1 is used if" in text
    assert "data.on_bad=skip What cannot be read: skip" in text
    assert "[skip, raise]" in text
    assert "data.category=hydrant" in text
    assert "Made by completesplat.data.co3d.module.CO3DDataModule." in text
    assert "optimizer.lr=5.0e-5" in help_page("fit", ["optimizer"])
    assert "trainer.max_steps=" in help_page("fit", ["trainer"])
    pages = [help_page("fit", [group]) for group in ("data", "model", "evaluation", "ablation")]
    assert max(len(line) for text in pages for line in text.splitlines()) <= WIDTH


def test_unknown_parts_are_answered_with_the_nearest():
    for word, message in (
        ("data=toy_object", "no data 'toy_object': there are .*; did you mean toy_objects"),
        ("modle", "nothing to say on 'modle'; did you mean mode or model"),
        ("batchsize", "nothing to say on 'batchsize'; did you mean batch_size"),
        ("model.loss", "nothing to say on"),  # a reference
        ("_target_", "nothing to say on"),
    ):
        with pytest.raises(CompleteSplatError, match=message):
            help_page("fit", [word])


def found(*words: str) -> list[str]:
    """The keys that `fit --help WORDS` shows."""
    return re.findall(r"^  (\w[\w.]*)(?==| |$)", help_page("fit", [*words]), re.MULTILINE)


def test_a_word_is_searched_for_in_the_names_and_comments_of_all_options():
    assert found("lr") == ["optimizer.lr", "optimizer.adam_lr"]  # not in "already", and not once for each experiment
    assert "optimizer.adam_lr=3.0e-3" in help_page("fit", ["lr"])
    assert "learning rate of biases and norms [number, at least 0] (optimizer=muon)" in help_page("fit", ["lr"])
    assert found("trainer.max_steps")[0] == found("max", "steps")[0] == "trainer.max_steps"
    assert found("batch_size")[0] == "data.batch_size"  # names come before comments
    assert {"optimizer.lr", "optimizer.adam_lr"} < set(found("learning_rate"))


def test_every_group_is_explained_and_every_option_is_read():
    assert set(conf.groups()) <= conf.about_groups().keys()
    for group in conf.groups():
        for option in conf.options(group):
            assert conf.settings_of_option(group, option) is not None


def test_a_files_lines_are_read_as_they_explain_themselves():
    written = conf.parse(
        "# @package _global_\n# About it.\n\n# Of the first.\na: 1\nb: [1, 2] # of the second\n"
        "e: # With entries.\n  - 1\n# Of all.\npart:\n"
        "  # Of the inner\n  # one.\n  c: x\n  d: null\n"
        "defaults:\n  - _base\n  - override /data@here: toy # why\n  - _self_\n"
    )
    assert (written.about, written.package) == ("About it.", "_global_")
    assert [tuple(setting) for setting in written.settings] == [
        ("a", "1", "Of the first."),
        ("b", "[1, 2]", "of the second"),
        ("e", "", "With entries."),
        ("part.c", "x", "Of the inner one."),
        ("part.d", "null", ""),
    ]
    assert [tuple(one) for one in written.choices] == [("data", "here", "toy", "why")]
    assert written.bases == ["_base"]
