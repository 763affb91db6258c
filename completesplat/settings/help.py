"""`completesplat VERB --help`: the settings with their comments in `conf/`, allowed values, and examples."""

import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.settings.checks import OF_VERBS
from completesplat.settings.options import (
    TASKS,
    Choice,
    Setting,
    about_groups,
    choices_of_verb,
    conf_folder,
    meant,
    options,
    read,
    settings_of_option,
    settings_of_verb,
    with_bases,
)
from completesplat.settings.schema import arguments_of, described, hints_of

WIDTH, COLUMN = 120, 24
REMARK = "the paper"
FLAGS = ("--help", "-h")
NEEDED = "???"
ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {6,}\S.*)*)", re.MULTILINE)
"""An entry of a docstring's `Args:`, for one argument or several."""


def page(verb: str, arguments: Sequence[str]) -> str:
    """Return the help text of a verb, of one of its tasks (`data toy --help`) or groups (`fit --help data`).

    Raises:
        CompleteSplatError: there is no such task or group.
    """
    words = [argument for argument in arguments if argument not in FLAGS and not argument.startswith("-")]
    task = None
    if verb in TASKS:
        default = next(choice.option for choice in read(verb).choices if choice.group == f"{verb}_task")
        task = words.pop(0) if words and words[0] in options(f"{verb}_task") else default
    groups = {choice.place: choice for choice in choices_of_verb(verb, task)}
    for word in words:
        group, _, option = word.partition("=")
        if group in groups and group != "hydra":
            return part_page(verb, groups[group], option or groups[group].option)
        if "=" not in word:
            tasks = options(f"{verb}_task") if verb in TASKS else []
            raise CompleteSplatError(f"nothing to say on {word!r}{meant(word, [*groups, *tasks])}")
    return "\n\n".join(
        [str(OmegaConf.load(conf_folder() / f"{verb}.yaml").hydra.help.header).strip(), *_body(verb, task)]
    )


def _body(verb: str, task: str | None) -> list[str]:
    parts = []
    if task is not None:
        rows = [(name, _first_sentence(read(f"{verb}_task/{name}").about)) for name in options(f"{verb}_task")]
        parts.append(f"Tasks (completesplat {verb} TASK --help shows one):\n\n" + "\n".join(_row(*row) for row in rows))
    of_task = f" of {verb} {task}" if task is not None else ""
    hints = _hints(verb, task)
    lines = [_line(setting, hints.get(setting.key), {}, verb) for setting in settings_of_verb(verb, task)]
    parts.append(f"Settings{of_task} (key=value):\n\n" + "\n".join(lines))
    groups, about = choices_of_verb(verb, task), about_groups()
    if groups:
        rows = [(_chosen(group), _about(group, about)) for group in groups]
        heading = (
            f"Parts (group=option chooses; completesplat {f'{verb} {task}' if task else verb} --help GROUP shows one):"
        )
        parts.append(f"{heading}\n\n" + "\n".join(_row(*row) for row in rows))
    return [
        *parts,
        "A sweep over values: -m key=a,b. Lists and values with spaces want the shell's quotes: 'key=[a,b]'.",
    ]


def part_page(verb: str, choice: Choice, option: str) -> str:
    """Return the help text of one option of a group.

    Raises:
        CompleteSplatError: the group has no option of this name.
    """
    named = options(choice.group)
    if option == "null":
        message = f"{choice.place}: {_about(choice, about_groups())}"
        return f"{_wrapped(message)}\nTo see one: completesplat {verb} --help {choice.place}=OPTION"
    if option not in named:
        raise CompleteSplatError(f"no {choice.group} {option!r}: there are {', '.join(named)}{meant(option, named)}")
    place = None if choice.place == choice.group else choice.place
    settings = settings_of_option(choice.group, option, place)
    targets = {key.removesuffix("._target_"): value for key, value, _ in settings if key.endswith("._target_")}
    settings = [setting for setting in settings if not setting.key.rpartition(".")[2].startswith("_")]
    known = {key: _of_target(target) for key, target in targets.items()}
    lines = []
    for setting in settings:
        above, _, name = setting.key.rpartition(".")
        if not re.fullmatch(r"\$\{\w+\}", setting.value):
            hints, documented = known.get(above, ({}, {}))
            lines.append(_line(setting, hints.get(name), documented))
    about = with_bases(choice.group, option).about.strip()
    head = f"{choice.place}={option}" + (f"\n{_wrapped(about)}" if about else "")
    made = [f"Made by {target}." for key, target in targets.items() if key == choice.place]
    return "\n\n".join(
        [head, "\n".join(lines) or "No settings of its own.", *made, _wrapped(f"Others: {', '.join(named)}")]
    )


def _wrapped(text: str) -> str:
    """Wrap lines at 120 columns, except commands, which are indented."""
    lines = [[line] if line.startswith(" ") else textwrap.wrap(line, WIDTH) for line in text.splitlines()]
    return "\n".join(line for some in lines for line in some)


def _first_sentence(text: str) -> str:
    return re.split(r"(?<=[.:])\s", text.replace("\n", " ").partition(": ")[2] or text)[0].rstrip(":")


def _hints(verb: str, task: str | None) -> Mapping[str, Any]:
    """Return the annotations of a verb's own settings, where the function that takes them can be imported."""
    if verb in OF_VERBS:
        return hints_of(OF_VERBS[verb])
    named = {setting.key: setting.value for setting in with_bases(f"{verb}_task", task).settings} if task else {}
    return _of_target(named.get("task._target_", ""))[0]


def _of_target(target: str) -> tuple[Mapping[str, Any], Mapping[str, str]]:
    """Return annotations and descriptions (from docstrings) of a class's or function's arguments, by name."""
    module, _, name = target.rpartition(".")
    try:
        function = getattr(import_module(module), name)
        hints, _ = arguments_of(function)
    except Exception:  # help also works where this machine lacks a package
        return {}, {}
    descriptions: dict[str, str] = {}
    for kind in function.__mro__ if isinstance(function, type) else (function,):
        for names, text in ENTRY.findall(inspect.cleandoc(kind.__doc__ or "")):
            descriptions = {argument: " ".join(text.split()) for argument in names.split(", ")} | descriptions
    return hints, descriptions


def _line(setting: Setting, hint: Any, documented: Mapping[str, str], verb: str = "") -> str:
    value = setting.value.replace("${verb}", verb).replace("${run_name:}", "TIME")
    key = setting.key if value in ("", NEEDED) or "${" in value else f"{setting.key}={value}"
    kind = described(hint) or _kind_of(value)
    documentation = documented.get(setting.key.rpartition(".")[2], "")
    # A remark on the paper follows the description; any other comment replaces it.
    text = f"{documentation} {setting.comment}" if REMARK in setting.comment[:20] else setting.comment or documentation
    parts = ["needed;" if value == NEEDED else "", text.strip(), f"[{kind}]" if kind else ""]
    return _row(key, " ".join(filter(None, parts)))


def _kind_of(value: str) -> str:
    """Return the kind of a setting, judged by its value, for settings without an annotation."""
    kinds = {r"true|false": "true or false", r"-?\d+": "whole number", r"-?\d*\.\d*(e[+-]?\d+)?": "number"}
    kinds |= {r"\[.*": "list", r"\{.*": "mapping"}
    return next((kind for pattern, kind in kinds.items() if re.fullmatch(pattern, value)), "")


def _chosen(choice: Choice) -> str:
    return choice.place if choice.option == "null" else f"{choice.place}={choice.option}"


def _about(choice: Choice, about: Mapping[str, str]) -> str:
    text = (choice.comment or about.get(choice.group, "")).replace("`", "").rstrip(".")
    return f"{text} [{', '.join(options(choice.group))}]".strip()


def _row(key: str, text: str) -> str:
    """Format a key with a text beside it, in lines of at most 120 columns."""
    indent = " " * COLUMN
    lines = textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False) or [""]
    if len(key) + 3 <= COLUMN:
        return f"  {key}".ljust(COLUMN) + "\n".join(lines)[COLUMN:]
    return "\n".join([f"  {key}", *(line for line in lines if line)])
