"""What the README and `--help` tell people to type is accepted."""

import pytest
from omegaconf import OmegaConf
from written_commands import arguments_of, composed, help_commands, readme_commands

from completesplat.cli import VERBS


def test_every_verb_has_examples():
    assert {arguments_of(command)[0] for command in help_commands()} == set(VERBS)


def test_the_readme_shows_every_verb():
    assert {arguments_of(command)[0] for command in readme_commands()} >= set(VERBS)


@pytest.mark.parametrize("command", sorted({*help_commands(), *readme_commands()}))
def test_the_command_composes(command):
    if arguments_of(command)[-1] != "--help":
        assert OmegaConf.to_container(composed(command))
