"""What the documents and `--help` tell people to type is accepted."""

import pytest
import written_commands as written
from omegaconf import OmegaConf

from completesplat.cli import VERBS
from completesplat.commands import conf_folder

EXPERIMENTS = [path.stem for path in sorted((conf_folder() / "experiment").glob("[!_]*.yaml"))]


def test_every_verb_has_examples_is_named_in_the_readme_and_shown_in_the_documents():
    named = [*written.block_commands(written.README), *written.inline_commands(written.README)]
    shown = [command for document in written.DOCUMENTS for command in written.block_commands(document)]
    assert {written.arguments_of(command)[0] for command in named} >= set(VERBS)
    for commands in (written.help_commands(), shown):
        assert {written.arguments_of(command)[0] for command in commands} == set(VERBS)


@pytest.mark.parametrize("command", sorted({*written.help_commands(), *written.document_commands()}))
def test_the_command_composes(command):
    if "hydra/sweeper=optuna" in command:
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="hydra-optuna-sweeper is not installed")
    if written.arguments_of(command)[-1] != "--help":
        assert OmegaConf.to_container(written.composed(command))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_lists_what_comes_before_it(experiment):
    """Its own command comes last; what each is given as DIR, STORE or RUN is what one before it wrote."""
    commands = written.experiment_commands(experiment)
    assert f"fit experiment={experiment} " in commands[-1]
    made = {"ROOT"} if experiment.startswith(("co3d_", "paper_")) else set()
    for command in commands:
        given = dict(argument.split("=", 1) for argument in written.arguments_of(command) if "=" in argument)
        folder = given.pop("out")
        named = {value.split("/")[0] for value in given.values()} & {"ROOT", "STORE", "DATA", "LATENTS"}
        named |= {value.split("/")[0] for value in given.values() if value.startswith("RUN")}
        assert named <= made
        made.add(folder)
        assert OmegaConf.to_container(written.composed(command))
    if experiment.startswith(("co3d_", "paper_")):
        assert commands[0].startswith("completesplat data prepare ")
