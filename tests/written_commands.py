"""The commands that the documents and the verbs' `--help` print: found, and composed as the command line would."""

import re
import shlex
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from support import compose_config

from completesplat.cli import VERBS
from completesplat.settings.arguments import SWEEP, for_hydra
from completesplat.settings.options import conf_folder

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
CARDS = sorted((ROOT / "completesplat/weights").rglob("README.md"))
FOLDERS = [*sorted((ROOT / "completesplat").rglob("README.md")), ROOT / "conf/README.md"]
STUDIES = ROOT / "notebooks/experiments.md"
CHANGELOG = ROOT / "CHANGELOG.md"
DOCUMENTS = [README, ROOT / "CONTRIBUTING.md", CHANGELOG, ROOT / "SECURITY.md", *FOLDERS, STUDIES]

BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(completesplat [^`]+)`")


def block_commands(document: Path) -> list[str]:
    """Lines of its code blocks that start with `completesplat`, without comments; a backslash joins lines."""
    blocks = [block.replace("\\\n", " ") for block in BLOCK.findall(document.read_text())]
    lines = [line for block in blocks for line in block.splitlines()]
    return [plain(line) for line in lines if line.startswith("completesplat ")]


def inline_commands(document: Path) -> list[str]:
    """The commands within its sentences and tables; those without a setting may be a verb's name alone."""
    return [plain(command) for command in INLINE.findall(BLOCK.sub("", document.read_text()))]


def document_commands() -> list[str]:
    """All complete commands of all documents, each once."""
    result = [command for document in DOCUMENTS for command in block_commands(document)]
    result += [command for document in DOCUMENTS for command in inline_commands(document) if "=" in command]
    return list(dict.fromkeys(result))


def help_commands() -> list[str]:
    """The examples of every verb's configuration."""
    lines = [line.strip() for verb in VERBS for line in (conf_folder() / f"{verb}.yaml").read_text().splitlines()]
    return [plain(line) for line in lines if line.startswith("completesplat ") and "${" not in line]


def experiment_commands(name: str) -> list[str]:
    """What the head of an experiment's file lists, in order; a backslash joins lines."""
    text = (conf_folder() / "experiment" / f"{name}.yaml").read_text()
    comments = "\n".join(line[1:] for line in text.splitlines() if line.startswith("#")).replace("\\\n", " ")
    return [" ".join(line.split()) for line in comments.splitlines() if line.strip().startswith("completesplat ")]


def plain(line: str) -> str:
    """A command as the shell reads it: without its comment, quoted in one way."""
    return shlex.join(shlex.split(line, comments=True))


def arguments_of(command: str) -> list[str]:
    """Verb and arguments; what follows a # is a comment."""
    return shlex.split(command, comments=True)[1:]


def composed(command: str):
    """The configuration of a written command; of a sweep, that of its first job.

    Raises:
        hydra.errors.HydraException: the command would be refused.
    """
    verb, *arguments = arguments_of(command)
    given = [argument for argument in for_hydra(verb, arguments) if argument not in SWEEP]
    return compose_config(verb, *map(_first_job, given))


def _first_job(argument: str) -> str:
    override = OverridesParser.create().parse_override(argument)
    if not override.is_sweep_override():
        return argument
    if isinstance(override.value(), IntervalSweep):
        return f"{override.get_key_element()}={override.value().start}"
    value = "full" if "glob(" in argument else str(next(override.sweep_string_iterator()))
    return f"{override.get_key_element()}={value}"
