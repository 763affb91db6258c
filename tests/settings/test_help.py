"""`VERB --help`: the settings of each verb and task with their comments in `conf/`."""

import re

import pytest

from completesplat.cli import VERBS
from completesplat.errors import CompleteSplatError
from completesplat.settings.composition import compose
from completesplat.settings.help import defaults, help_page, setting_blocks
from completesplat.settings.options import TASKS, options

PAGES = [(verb, None) for verb in VERBS]
PAGES += [(verb, task) for verb in TASKS for task in options(f"{verb}_task")]


@pytest.mark.parametrize(("verb", "task"), PAGES)
def test_a_page_has_its_settings_each_with_a_comment_and_its_parts(verb, task):
    text = help_page(verb, [] if task is None else [task])
    assert text.startswith(f"completesplat {verb}")
    name = verb if task is None else f"{verb}_task/{task}"
    bases, choices = defaults(name)
    for place in choices:
        assert re.search(rf"^  {re.escape(place)}=", text, re.MULTILINE), place
    for block in [block for file in (*bases, name) for block in setting_blocks(file)]:
        assert block in text
    config = compose(verb, *([] if task is None else [f"{verb}_task={task}"]))
    parts = {place.partition(".")[0] for place in choices}
    names = (
        config.keys()
        - parts
        - {"verb", "description", "task", "hydra", "experiment", "ablation", "hparams_search", "debug"}
    )
    if task is not None or verb not in TASKS:
        for setting in names - {"out"}:
            assert re.search(rf"^  {setting}:", text, re.MULTILINE), setting


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_has_examples_and_its_tasks(verb):
    text = help_page(verb)
    assert "Examples:\n  completesplat " in text
    assert all(f"\n  {task} " in text for task in (options(f"{verb}_task") if verb in TASKS else []))


def test_a_setting_keeps_its_comment():
    assert "  # Number of samples of each photo.\n  samples: 4\n" in help_page("predict")
    assert "_target_" not in help_page("data", ["toy"])


def test_an_unknown_task_is_answered_with_the_nearest():
    with pytest.raises(CompleteSplatError, match=r"no task of completesplat data 'chck': .*; did you mean check"):
        help_page("data", ["chck", "--help"])
