"""The arguments behind a verb, rewritten for Hydra: words, file names with any characters, and settings."""

import os
import re
from collections.abc import Callable, Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from completesplat.errors import CompleteSplatError
from completesplat.files import printable
from completesplat.settings.options import TASKS, groups, meant, options

EXPORT = "--export"
WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--config-name", "-cn", "--info", "-i", "--config-dir", "-cd")
"""Hydra's flags that take the next argument as their value."""
SWEEP = ("-m", "--multirun")
MOST_SHOWN = 120  # characters of a value


def quoted(text: str) -> str:
    """Quote a text so that Hydra takes every character literally, without lists or references to other settings."""
    unreferring = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=unreferring, quote=Quote.single).with_quotes()


def behind_dashes(arguments: Sequence[str]) -> list[str]:
    """Remove `--`. No argument behind it is a flag, so `-name.png` becomes `./-name.png` there."""
    before = list(arguments).index("--") if "--" in arguments else len(arguments)
    behind = [f"./{argument}" if argument.startswith("-") else argument for argument in arguments[before + 1 :]]
    return [*arguments[:before], *behind]


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate Hydra's flags and their values from the other arguments, because Hydra takes no flags between them."""
    flags, others, remaining = [], [], iter(arguments)
    for argument in remaining:
        name, equals, value = argument.partition("=")
        if name == EXPORT or not name.startswith("-"):
            others.append(argument)
        elif name not in WITH_VALUE:
            flags.append(argument)
        elif value := value if equals else next(remaining, ""):
            flags.append(f"{name}={value}")
        else:
            raise CompleteSplatError(f"{name}: lacks its value; give {name} VALUE")
    return flags, others


def of_predict(arguments: Sequence[str]) -> list[str]:
    """Rewrite `a.jpg b.jpg` as `image=['a.jpg','b.jpg']`."""
    words, others = _split(arguments)
    if not words:
        return others
    if any(argument.startswith("image=") for argument in others):
        raise CompleteSplatError(f"give pictures by their names or as image=, not both: {_shown(words[0])}")
    pictures = ",".join(map(quoted, words))
    return [f"image=[{pictures}]" if len(words) > 1 else f"image={pictures}", *others]


def of_view(arguments: Sequence[str]) -> list[str]:
    """Rewrite `PATH` as `path='PATH'`, and `--export FILE` as `export='FILE'`."""
    plain, exported, remaining = [], [], iter(arguments)
    for argument in remaining:
        if argument.partition("=")[0] != EXPORT:
            plain.append(argument)
            continue
        file = argument.partition("=")[2] or next(remaining, "")
        if not file:
            raise CompleteSplatError(f"{EXPORT} needs a file: {EXPORT} page.html")
        exported.append(f"export={quoted(file)}")
    words, others = _split(plain)
    if len(words) > 1:
        raise CompleteSplatError(f"give one path to look at, not {' '.join(map(_shown, words))}")
    return [*(f"path={quoted(word)}" for word in words), *exported, *others]


def of_new(arguments: Sequence[str]) -> list[str]:
    """Rewrite `KIND NAME` as `kind='KIND' name='NAME'`."""
    words, others = _split(arguments)
    if len(words) > 2:
        raise CompleteSplatError(f"give one kind and one name, not {' '.join(map(_shown, words))}")
    return [f"{key}={quoted(word)}" for key, word in zip(("kind", "name"), words, strict=False)] + others


def of_task(verb: str) -> Callable[[Sequence[str]], list[str]]:
    """Return the function that rewrites a first argument `TASK` as `VERB_task=TASK`, for a verb with tasks."""

    def overrides(arguments: Sequence[str]) -> list[str]:
        if not arguments or "=" in arguments[0]:
            return list(arguments)
        return [f"{verb}_task={arguments[0]}", *arguments[1:]]

    return overrides


SHORT_FORMS = {"predict": of_predict, "view": of_view, "new": of_new, **{verb: of_task(verb) for verb in TASKS}}


def for_hydra(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return flags and settings as Hydra reads them, the flags first.

    A value that is the name of an existing file or folder is taken literally, whatever it contains: `a,b.jpg`.

    Raises:
        CompleteSplatError: a flag lacks its value, there are too many words, images are given by name and by `image=`,
            a word is no setting, a value cannot be read, several values come without `-m`, or `out=` is empty.
    """
    flags, others = split_flags(arguments)
    settings = [_with_file(argument) for argument in SHORT_FORMS.get(verb, list)(others)]
    for argument in settings:
        _refuse_unreadable(argument, any(flag in SWEEP for flag in flags))
    return [*flags, *settings]


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate words, which contain no `=` or name a file, from the other arguments."""
    words = [word for word in arguments if ("=" not in word and not word.startswith("~")) or os.path.isfile(word)]
    return words, [argument for argument in arguments if argument not in words]


def _with_file(argument: str) -> str:
    key, equals, value = argument.partition("=")
    if not equals or not os.path.exists(value):
        return argument
    try:
        override = OverridesParser.create().parse_override(argument)
        if not override.is_sweep_override() and not isinstance(override.value(), list | dict):
            return argument
    except HydraException:
        pass
    return f"{key}={quoted(value)}"


def _refuse_unreadable(argument: str, sweep: bool) -> None:
    key, equals, value = argument.partition("=")
    if not equals and not argument.startswith("~"):
        chosen = [f"{group}={argument}" for group in groups() if argument in options(group)]
        nearest = f"; did you mean {' or '.join(chosen)}?" if chosen else meant(argument, groups())
        raise CompleteSplatError(f"{_shown(argument)}: no setting, which are given as key=value{nearest}")
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException:
        example = f'"{key}={_readable(value)}"'
        message = "cannot be read; a text with such characters wants quotes"
        raise CompleteSplatError(f"{_shown(argument)}: {message}: {_shown(example)}") from None
    if override.is_sweep_override() and not sweep:
        message = f"several values; -m makes a run of each, and a list is {key}=[{value}]"
        raise CompleteSplatError(f"{_shown(argument)}: {_shown(message)}")
    if override.key_or_group == "out" and not override.is_sweep_override() and override.value() in ("", None):
        raise CompleteSplatError(f"{argument}: names no folder; give out=DIR")


def _readable(value: str) -> str:
    """Quote a value, or each entry of a list."""
    if not (value.startswith("[") and value.endswith("]")):
        return quoted(value)
    entries = re.split(r",(?![^\[\]]*\])", value[1:-1])  # an inner list is not split
    return f"[{','.join(quoted(entry.strip()) for entry in entries)}]"


def _shown(text: str) -> str:
    preview = printable(text)
    return preview if len(preview) <= MOST_SHOWN else f"{preview[:MOST_SHOWN]}..."
