"""`completesplat --help` and `completesplat VERB --help`: what `conf/` says of a verb and its settings."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from completesplat.errors import CompleteSplatError
from completesplat.settings.options import LOADER, TASKS, conf_folder, conf_text, did_you_mean, options, source_of

HELP_FLAGS = ("--help", "-h")
NO_SETTINGS = ("defaults", "verb", "description", "hydra", "task")
"""Keys of a file that are no settings of its verb."""
CHANGING_SEVERAL = ("debug", "hparams_search")
"""Config groups whose options change settings of several parts, which the pages show."""
WIDTH = 120


def help_page(verb: str, arguments: Sequence[str] = ()) -> str:
    """Return the help text of a verb, or of one of its tasks: `data import --help`.

    Raises:
        CompleteSplatError: the verb has no such task.
    """
    words = [argument for argument in arguments if not argument.startswith("-") and "=" not in argument]
    if verb not in TASKS or not words:
        return "\n\n".join([header(verb), *task_list(verb), *settings_and_parts(verb)])
    task = words[0]
    tasks = options(f"{verb}_task")
    if task not in tasks:
        message = f"no task of completesplat {verb} {task!r}: there are {', '.join(tasks)}"
        raise CompleteSplatError(message + did_you_mean(task, tasks))
    name = f"{verb}_task/{task}"
    return "\n\n".join([first_comment(name), *settings_and_parts(name)])


def describe(verb: str) -> str:
    """Return the description of a verb in its file."""
    return str(contents(verb)["description"])


def header(verb: str) -> str:
    """Return the description of a verb with its examples."""
    text = str(contents(verb)["hydra"]["help"]["header"])
    return text.replace("${verb}", verb).replace("${description}", describe(verb)).strip()


def task_list(verb: str) -> Iterator[str]:
    """Yield a list of the tasks of a verb that has some."""
    if verb in TASKS:
        lines = [f"Tasks (completesplat {verb} TASK --help shows the settings of one):"]
        for task in options(f"{verb}_task"):
            _, _, purpose = first_comment(f"{verb}_task/{task}").splitlines()[0].partition(": ")
            lines.append(f"  {task:12} {purpose}{from_extension(f'{verb}_task/{task}')}")
        yield "\n".join(lines)


def settings_and_parts(name: str) -> Iterator[str]:
    """Yield the settings of a file and of those that it inherits from, with their comments, and its config groups."""
    bases, choices = defaults(name)
    blocks = [block for file in (*bases, name) for block in setting_blocks(file)]
    if blocks:
        yield "\n".join(["Settings (key=value):", *blocks])
    if choices:
        lines = [f"Parts (group=option), with their settings in {conf_folder()}/GROUP/OPTION.yaml:"]
        for place, (group, option) in choices.items():
            default = "null" if option is None else option
            listed = [name + from_extension(f"{group}/{name}") for name in options(group)]
            lines.append(f"  {place}={default}  [{', '.join(listed)}]")
        yield "\n".join(lines)
    for group, _ in choices.values():
        if group in CHANGING_SEVERAL:
            yield "\n".join(option_changes(group))
    yield "A sweep over values: -m key=a,b. Lists and values with spaces want the shell's quotes: 'key=[a,b]'."


def from_extension(name: str) -> str:
    """Return an ending for an option (`GROUP/OPTION`) that tells its extension, empty for all other options."""
    extension = source_of(name)
    return "" if extension is None else f" (from {extension})"


def option_changes(group: str) -> Iterator[str]:
    """Yield lines with the purpose of each option of a config group, and the settings that it changes."""
    for option in options(group):
        name = f"{group}/{option}"
        purpose = " ".join(first_comment(name).partition("\n  completesplat ")[0].split())
        yield from textwrap.wrap(f"{group}={option}: {purpose}", WIDTH, break_on_hyphens=False)
        changes = " ".join(flat_settings(contents(name)))
        yield from textwrap.wrap(changes, WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)


def flat_settings(config: Mapping[str, Any], place: str = "") -> Iterator[str]:
    """Yield the settings of a file as `key=value`, with the options that it overrides."""
    for name, value in config.items():
        key = f"{place}{name}"
        if key == "defaults":
            for entry in value:
                ((group, option),) = entry.items()
                yield f"{group.removeprefix('override ').removeprefix('/')}={option}"
        elif isinstance(value, dict):
            yield from flat_settings(value, f"{key}.")
        else:
            yield f"{key}={_written(value)}"


def _written(value: object) -> str:
    """Return a value as the command line takes it."""
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def defaults(name: str) -> tuple[list[str], dict[str, tuple[str, str | None]]]:
    """Return the files that a file inherits settings from, and its choices: group and default option by place."""
    folder = name.rpartition("/")[0]
    bases: list[str] = []
    choices: dict[str, tuple[str, str | None]] = {}
    for entry in contents(name).get("defaults", []):
        if isinstance(entry, dict):
            ((key, option),) = entry.items()
            group, _, place = key.removeprefix("override ").removeprefix("/").partition("@")
            if group.endswith("_task"):
                continue
            if place == "_global_":
                bases.append(f"{group}/{option}")
            else:
                choices[place or group] = (group, option)
        elif entry != "_self_":
            base = f"{folder}/{entry}".removeprefix("/")
            inherited, further = defaults(base)
            bases += [*inherited, base]
            choices.update(further)
    return bases, choices


def setting_blocks(name: str) -> list[str]:
    """Return the settings of a file as they are written, each with the comments above it."""
    blocks: list[list[str]] = []
    comments: list[str] = []
    for line in conf_text(name).splitlines():
        if line.startswith("#"):
            comments.append(line)
        elif line.startswith(" "):
            blocks[-1].append(line)
        elif not line:
            comments = []
        else:
            blocks.append([*comments, line])
            comments = []
    settings = []
    for block in blocks:
        key_line = next(line for line in block if not line.startswith("#"))
        if key_line.partition(":")[0] not in NO_SETTINGS:
            settings.append("\n".join(f"  {line}" for line in block))
    return settings


def first_comment(name: str) -> str:
    """Return the comment at the top of a file, without Hydra's line on its package."""
    lines = []
    for line in conf_text(name).splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package "):
            lines.append(line.removeprefix("#").removeprefix(" "))
    return "\n".join(lines)


@cache
def contents(name: str) -> dict[str, Any]:
    """Return the keys and values of a file of `conf/`."""
    return dict(LOADER(conf_text(name)).get_single_data())
