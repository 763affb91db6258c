"""What the documents and `--help` tell people to type is accepted."""

import pytest
from omegaconf import OmegaConf
from written_commands import (
    DOCUMENTS,
    README,
    arguments_of,
    block_commands,
    composed,
    document_commands,
    experiment_commands,
    help_commands,
    inline_commands,
)

from completesplat.cli import VERBS
from completesplat.commands import conf_folder

EXPERIMENTS = [path.stem for path in sorted((conf_folder() / "experiment").glob("[!_]*.yaml"))]


def test_every_verb_has_examples_is_named_in_the_readme_and_shown_in_the_documents():
    named = [*block_commands(README), *inline_commands(README)]
    shown = [command for document in DOCUMENTS for command in block_commands(document)]
    assert {arguments_of(command)[0] for command in named} >= set(VERBS)
    for commands in (help_commands(), shown):
        assert {arguments_of(command)[0] for command in commands} == set(VERBS)


@pytest.mark.parametrize("command", sorted({*help_commands(), *document_commands()}))
def test_the_command_composes(command):
    if arguments_of(command)[-1] != "--help":
        assert OmegaConf.to_container(composed(command))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_lists_what_comes_before_it(experiment):
    """Its own command comes last; what each is given as DIR, STORE or RUN is what one before it wrote."""
    commands = experiment_commands(experiment)
    assert f"fit experiment={experiment} " in commands[-1]
    written = {"ROOT"} if experiment.startswith(("co3d_", "re10k_")) else set()
    written |= {"RUN1", "DATA"} if experiment == "toy_diffusion_small" else set()  # of toy_var_small
    for command in commands:
        given = dict(argument.split("=", 1) for argument in arguments_of(command) if "=" in argument)
        folder = given.pop("out")
        named = {value.split("/")[0] for value in given.values()} & {"ROOT", "STORE", "DATA", "LATENTS"}
        named |= {value.split("/")[0] for value in given.values() if value.startswith("RUN")}
        assert named <= written
        written.add(folder)
        assert OmegaConf.to_container(composed(command))
    if experiment.startswith(("co3d_", "re10k_")):
        assert commands[0].startswith("completesplat data prepare ")
