"""Commands in the documents and in `--help` are accepted."""

import re
from importlib.util import find_spec

import pytest
import written_commands as written
from hydra.errors import HydraException

from completesplat.cli import VERBS
from completesplat.errors import CompleteSplatError
from completesplat.settings.options import conf_folder

FOLDER = re.compile(r"ROOT|STORE|DATA|LATENTS|RUN\w*")
EXPERIMENTS = [path.stem for path in sorted((conf_folder() / "experiment").glob("[!_]*.yaml"))]


def test_every_verb_has_examples_is_named_in_the_readme_and_shown_in_the_documents():
    named = [*written.block_commands(written.README), *written.inline_commands(written.README)]
    shown = [command for document in written.DOCUMENTS for command in written.block_commands(document)]
    assert {written.arguments_of(command)[0] for command in named} >= set(VERBS)
    for commands in (written.help_commands(), shown):
        assert {written.arguments_of(command)[0] for command in commands} == set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_command_of_a_verb_composes(verb):
    commands = sorted({*written.help_commands(), *written.document_commands()})
    refused = []
    for command in [text for text in commands if written.arguments_of(text)[0] == verb and "--help" not in text]:
        if "=optuna" not in command or find_spec("hydra_plugins.hydra_optuna_sweeper"):
            try:
                written.composed(command)
            except (HydraException, CompleteSplatError) as error:
                refused.append((command, error))
    assert refused == []


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_lists_what_comes_before_it(experiment):
    """Its own command comes last. Each folder that a command reads was written by one before it."""
    commands = written.experiment_commands(experiment)
    assert f"fit experiment={experiment} " in commands[-1]
    made = {"ROOT"}  # the user's data
    for command in commands:
        given = dict(argument.split("=", 1) for argument in written.arguments_of(command) if "=" in argument)
        folder = given.pop("out")
        named = {value.split("/")[0] for value in given.values()}
        assert {name for name in named if FOLDER.fullmatch(name)} <= made
        made.add(folder)
        written.composed(command)
