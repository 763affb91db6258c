"""`completesplat VERB --help`: the settings with their comments in `conf/`, allowed values, and examples."""

import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module

from omegaconf import OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.settings import options as conf
from completesplat.settings.schema import VERBS, arguments_of, described, hints_of

WIDTH = 120
COLUMN = 24
REMARK = "the paper"
FLAGS = ("--help", "-h")
NEEDED = "???"
ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {6,}\S.*)*)", re.MULTILINE)
"""An entry of a docstring's `Args:`, for one argument or several."""


def help_page(verb: str, arguments: Sequence[str]) -> str:
    """Return the help text of a verb, a task (`data toy --help`), a group (`fit --help data`), or of words to search.

    Raises:
        CompleteSplatError: no setting has the words in its name or comment.
    """
    words = [argument for argument in arguments if not argument.startswith("-")]
    task = None
    if verb in conf.TASKS:
        default = next(choice.option for choice in conf.read_conf_file(verb).choices if choice.group == f"{verb}_task")
        task = words.pop(0) if words and words[0] in conf.options(f"{verb}_task") else default
    groups = {choice.place: choice for choice in conf.choices_of_verb(verb, task)}
    for word in words:
        group, _, option = word.partition("=")
        if group in groups and group != "hydra":
            return part_page(verb, groups[group], option or groups[group].option)
    if wanted := [word for word in words if "=" not in word]:
        return search_page(verb, task, wanted)
    header = str(OmegaConf.load(conf.conf_folder() / f"{verb}.yaml").hydra.help.header).strip()
    return "\n\n".join([header, *_body(verb, task)])


def _body(verb: str, task: str | None) -> Iterator[str]:
    command = verb if task is None else f"{verb} {task}"
    if task is not None:
        files = {name: conf.read_conf_file(f"{verb}_task/{name}") for name in conf.options(f"{verb}_task")}
        rows = [(name, _first_sentence(file.about)) for name, file in files.items()]
        yield _table(f"Tasks (completesplat {verb} TASK --help shows one):", rows)
    hints = _hints(verb, task)
    rows = [_line(setting, hints.get(setting.key), {}, verb) for setting in conf.settings_of_verb(verb, task)]
    yield _table(f"Settings{'' if task is None else f' of {command}'} (key=value):", rows)
    about = conf.about_groups()
    if choices := [choice for choice in conf.choices_of_verb(verb, task) if choice.place != "_global_"]:
        keys = [entry.place if entry.option == "null" else f"{entry.place}={entry.option}" for entry in choices]
        rows = [(key, _about(choice, about)) for key, choice in zip(keys, choices, strict=True)]
        yield _table(f"Parts (group=option chooses; completesplat {command} --help GROUP shows one):", rows)
    yield f"A setting by its name or comment: completesplat {command} --help WORD. A sweep over values: -m key=a,b."
    yield "Lists and values with spaces want the shell's quotes: 'key=[a,b]'."


def search_page(verb: str, task: str | None, words: Sequence[str]) -> str:
    """Return the help text of the settings that `search_settings` finds; raise CompleteSplatError if there are none."""
    hints = _hints(verb, task)
    rows = []
    for setting, part, option in conf.search_settings(verb, task, words):
        key, text = _part_line(setting, part) if part else _line(setting, hints.get(setting.key), {}, verb)
        rows.append((key, text + option))
    if not rows:
        known = {setting.key.rpartition(".")[2] for setting, _, _ in conf.search_settings(verb, task, [])}
        known |= {choice.place for choice in conf.choices_of_verb(verb, task)} | set(conf.options(f"{verb}_task"))
        raise CompleteSplatError(f"nothing to say on {' '.join(words)!r}{conf.did_you_mean(words[0], sorted(known))}")
    return _table(f"Settings of completesplat {verb} on {' '.join(words)} (key=value):", rows)


def part_page(verb: str, choice: conf.GroupDefault, option: str) -> str:
    """Return the help text of one option of a group; raise CompleteSplatError if the group has no such option."""
    known = conf.options(choice.group)
    if option == "null":
        message = f"{choice.place}: {_about(choice, conf.about_groups())}"
        return f"{_wrapped(message)}\nTo see one: completesplat {verb} --help {choice.place}=OPTION"
    if option not in known:
        nearest = conf.did_you_mean(option, known)
        raise CompleteSplatError(f"no {choice.group} {option!r}: there are {', '.join(known)}{nearest}")
    place = None if choice.place == choice.group else choice.place
    settings = conf.settings_of_option(choice.group, option, place)
    rows = [_part_line(each, settings) for each in settings if not conf.REFERRING.search(f"{each.key}={each.value}")]
    about = conf.with_bases(choice.group, option).about.strip()
    made = [f"Made by {value}." for key, value, _ in settings if key == f"{choice.place}._target_"]
    parts = [_table(f"{choice.place}={option}" + (f"\n{_wrapped(about)}" if about else ""), rows), *made]
    return "\n\n".join([*parts, _wrapped(f"Others: {', '.join(known)}")])


def _wrapped(text: str) -> str:
    """Wrap lines at 120 columns, except commands, which are indented."""
    lines = [[line] if line.startswith(" ") else textwrap.wrap(line, WIDTH) for line in text.splitlines()]
    return "\n".join(line for some in lines for line in some)


def _first_sentence(text: str) -> str:
    """Return the first sentence of a text, without the command's name before it."""
    sentence = text.replace("\n", " ").partition(": ")[2] or text
    return re.split(r"(?<=[.:])\s", sentence)[0].rstrip(":")


def _hints(verb: str, task: str | None) -> Mapping[str, object]:
    """Return the annotations of a verb's own settings, where the function that takes them can be imported."""
    if verb in VERBS:
        return hints_of(VERBS[verb])
    named = {setting.key: setting.value for setting in conf.with_bases(f"{verb}_task", task).settings} if task else {}
    return _of_target(named.get("task._target_", ""))[0]


@cache
def _of_target(target: str) -> tuple[Mapping[str, object], Mapping[str, str]]:
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


def _part_line(setting: conf.Setting, settings: Iterable[conf.Setting]) -> tuple[str, str]:
    """Return the line of a setting of a part, whose `settings` name the class or function that takes it."""
    above, _, name = setting.key.rpartition(".")
    target = next((value for key, value, _ in settings if key == f"{above}._target_"), "")
    hints, documented = _of_target(target)
    return _line(setting, hints.get(name), documented)


def _line(setting: conf.Setting, hint: object, documented: Mapping[str, str], verb: str = "") -> tuple[str, str]:
    value = setting.value.replace("${verb}", verb).replace("${run_name:}", "TIME")
    key = setting.key if value in ("", NEEDED) or "${" in value else f"{setting.key}={value}"
    kind = described(hint) or _kind_of(value)
    documentation = documented.get(setting.key.rpartition(".")[2], "")
    # A remark on the paper follows the description; any other comment replaces it.
    text = f"{documentation} {setting.comment}" if REMARK in setting.comment[:20] else setting.comment or documentation
    parts = ["needed;" if value == NEEDED else "", text.strip(), f"[{kind}]" if kind else ""]
    return key, " ".join(filter(None, parts))


def _kind_of(value: str) -> str:
    """Return the kind of a setting, judged by its value, for settings without an annotation."""
    kinds = {r"true|false": "true or false", r"-?\d+": "whole number", r"-?\d*\.\d*(e[+-]?\d+)?": "number"}
    kinds |= {r"\[.*": "list", r"\{.*": "mapping"}
    return next((kind for pattern, kind in kinds.items() if re.fullmatch(pattern, value)), "")


def _about(choice: conf.GroupDefault, about: Mapping[str, str]) -> str:
    text = (choice.comment or about.get(choice.group, "")).replace("`", "").rstrip(".")
    return f"{text} [{', '.join(conf.options(choice.group))}]".strip()


def _table(heading: str, rows: Iterable[tuple[str, str]]) -> str:
    """Format keys with a text beside each, in lines of at most 120 columns."""
    lines = [heading, ""]
    indent = " " * COLUMN
    for key, text in rows:
        wrapped = textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False)
        if len(key) + 3 <= COLUMN:
            first, *wrapped = wrapped or [""]
            lines.append(f"  {key}".ljust(COLUMN) + first[COLUMN:])
        else:
            lines.append(f"  {key}")
        lines += wrapped
    return "\n".join(lines)
