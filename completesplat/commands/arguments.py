"""What people type behind a verb, made into what hydra reads: words, files of any name, and settings."""

import os
import re
from collections.abc import Callable, Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from completesplat.errors import CompleteSplatError
from completesplat.names import printable
from completesplat.options import TASKS, groups, meant, options

EXPORT = "--export"
WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--config-name", "-cn", "--info", "-i", "--config-dir", "-cd")
"""Hydra's flags behind which another argument belongs to them."""
SWEEP = ("-m", "--multirun")
MOST_SHOWN = 120  # characters of a value


def quoted(text: str) -> str:
    """A text as hydra takes it, every character as it is: neither lists nor references to other settings in it."""
    unreferring = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=unreferring, quote=Quote.single).with_quotes()


def behind_dashes(arguments: Sequence[str]) -> list[str]:
    """Remove `--`, behind which no argument is a flag: `-name.png` becomes `./-name.png`."""
    before = list(arguments).index("--") if "--" in arguments else len(arguments)
    behind = [f"./{one}" if one.startswith("-") else one for one in arguments[before + 1 :]]
    return [*arguments[:before], *behind]


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate Hydra's flags, with the values that belong to them, from the other arguments.

    Hydra takes flags before or behind the settings, not between them. `CompleteSplatError`: a flag lacks its value.
    """
    flags, others, given = [], [], iter(arguments)
    for argument in given:
        name, equals, value = argument.partition("=")
        if name == EXPORT or not name.startswith("-"):
            others.append(argument)
        elif name not in WITH_VALUE:
            flags.append(argument)
        elif value := value if equals else next(given, ""):
            flags.append(f"{name}={value}")
        else:
            raise CompleteSplatError(f"{name}: lacks its value; give {name} VALUE")
    return flags, others


def of_predict(arguments: Sequence[str]) -> list[str]:
    """`a.jpg b.jpg` as `image=['a.jpg','b.jpg']`; `CompleteSplatError` if `image=` is given besides."""
    words, others = _split(arguments)
    if not words:
        return others
    if any(argument.startswith("image=") for argument in others):
        raise CompleteSplatError(f"give pictures by their names or as image=, not both: {_shown(words[0])}")
    pictures = ",".join(map(quoted, words))
    return [f"image=[{pictures}]" if len(words) > 1 else f"image={pictures}", *others]


def of_view(arguments: Sequence[str]) -> list[str]:
    """`PATH` as `path='PATH'`, and `--export FILE` as `export='FILE'`; `CompleteSplatError` for two paths."""
    plain, exported, given = [], [], iter(arguments)
    for argument in given:
        if argument.partition("=")[0] != EXPORT:
            plain.append(argument)
            continue
        file = argument.partition("=")[2] or next(given, "")
        if not file:
            raise CompleteSplatError(f"{EXPORT} needs a file: {EXPORT} page.html")
        exported.append(f"export={quoted(file)}")
    words, others = _split(plain)
    if len(words) > 1:
        raise CompleteSplatError(f"give one path to look at, not {' '.join(map(_shown, words))}")
    return [*(f"path={quoted(word)}" for word in words), *exported, *others]


def of_new(arguments: Sequence[str]) -> list[str]:
    """`KIND NAME` as `kind='KIND' name='NAME'`; `CompleteSplatError` for more words."""
    words, others = _split(arguments)
    if len(words) > 2:
        raise CompleteSplatError(f"give one kind and one name, not {' '.join(map(_shown, words))}")
    return [f"{key}={quoted(word)}" for key, word in zip(("kind", "name"), words, strict=False)] + others


def of_task(verb: str) -> Callable[[Sequence[str]], list[str]]:
    """For a verb with tasks: `TASK` as `VERB_task=TASK`, if it is the first argument."""

    def overrides(arguments: Sequence[str]) -> list[str]:
        if not arguments or "=" in arguments[0]:
            return list(arguments)
        return [f"{verb}_task={arguments[0]}", *arguments[1:]]

    return overrides


SHORT_FORMS = {"predict": of_predict, "view": of_view, "new": of_new, **{verb: of_task(verb) for verb in TASKS}}


def for_hydra(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return flags and settings as Hydra reads them, the flags first.

    The value of a setting that is the name of a file or folder as it stands is that name, whatever is in it: `a,b.jpg`.

    Raises:
        CompleteSplatError: a word that is no setting, a value that cannot be read, several values without `-m`.
    """
    flags, others = split_flags(arguments)
    settings = [_with_file(argument) for argument in SHORT_FORMS.get(verb, list)(others)]
    for argument in settings:
        _refuse_unreadable(argument, any(flag in SWEEP for flag in flags))
    return [*flags, *settings]


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate words, which have no = or name a file, from the other arguments."""
    words = [one for one in arguments if ("=" not in one and not one.startswith("~")) or os.path.isfile(one)]
    return words, [one for one in arguments if one not in words]


def _with_file(argument: str) -> str:
    key, equals, value = argument.partition("=")
    if not equals or not os.path.exists(value):
        return argument
    try:
        read = OverridesParser.create().parse_override(argument)
        if not read.is_sweep_override() and not isinstance(read.value(), list | dict):
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
        read = OverridesParser.create().parse_override(argument)
    except HydraException:
        example = f'"{key}={_readable(value)}"'
        said = "cannot be read; a text with such characters wants quotes"
        raise CompleteSplatError(f"{_shown(argument)}: {said}: {_shown(example)}") from None
    if read.is_sweep_override() and not sweep:
        said = f"several values; -m makes a run of each, and a list is {key}=[{value}]"
        raise CompleteSplatError(f"{_shown(argument)}: {_shown(said)}")
    if read.key_or_group == "out" and not read.is_sweep_override() and read.value() in ("", None):
        raise CompleteSplatError(f"{argument}: names no folder; give out=DIR")


def _readable(value: str) -> str:
    """The value in quotes; of a list, its entries."""
    if not (value.startswith("[") and value.endswith("]")):
        return quoted(value)
    entries = re.split(r",(?![^\[\]]*\])", value[1:-1])  # a list inside stays whole
    return f"[{','.join(quoted(entry.strip()) for entry in entries)}]"


def _shown(text: str) -> str:
    shown = printable(text)
    return shown if len(shown) <= MOST_SHOWN else f"{shown[:MOST_SHOWN]}..."
