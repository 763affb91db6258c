"""Conversion of the arguments behind a verb to Hydra's: words, file names with any characters, and settings."""

import os
import re
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from completesplat.errors import CompleteSplatError
from completesplat.files import SHORT, printable
from completesplat.settings.options import TASKS, did_you_mean, groups, options

EXPORT = "--export"
WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--config-name", "-cn", "--info", "-i", "--config-dir", "-cd")
"""Hydra's flags that take the next argument as their value."""
ALONE = (
    *("--help", "-h", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"),
    *("--shell-completion", "-sc", "--config-path", "-cp", "--experimental-rerun"),
)
"""Hydra's other flags."""
INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
CFG = ("job", "hydra", "all")
CHOICES = {"--info": INFO, "-i": INFO, "--cfg": CFG, "-c": CFG}
DASHES = (
    "settings are key=value without dashes, such as out=DIR, and files are given by their names: "
    "`completesplat predict PHOTO out=DIR`"
)
SWEEP = ("-m", "--multirun")
PLAIN = re.compile(r"[\w ./+@%-]+")  # with letters of any language, which Hydra wants quoted
WORDS = {"predict": ("image",), "view": ("path",), "new": ("kind", "name"), "data import": ("folder",)}
"""By verb, or verb and task, the settings whose values are given as words without `=`."""


def quoted(text: str) -> str:
    """Quote a text so that Hydra takes every character literally, without lists or references to other settings."""
    unreferring = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return QuotedString(text=unreferring, quote=Quote.single).with_quotes()


def behind_dashes(arguments: Sequence[str]) -> list[str]:
    """Remove `--`. The arguments behind it are not flags, so `-name.png` becomes `./-name.png` there."""
    before = list(arguments).index("--") if "--" in arguments else len(arguments)
    behind = [f"./{argument}" if argument.startswith("-") else argument for argument in arguments[before + 1 :]]
    return [*arguments[:before], *behind]


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate Hydra's flags and their values from the other arguments, because Hydra takes no flags between them.

    `--export FILE`, which is not Hydra's, becomes the setting `export='FILE'`, and `--key=value` becomes `key=value`,
    because W&B's agents give settings so.
    """
    flags = []
    others = []
    remaining = iter(arguments)
    for argument in remaining:
        name, equals, value = argument.partition("=")
        if not name.startswith("-"):
            others.append(argument)
        elif name in ALONE:
            flags.append(argument)
        elif name not in (*WITH_VALUE, EXPORT):
            if not equals or not name.startswith("--"):
                raise CompleteSplatError(f"{argument}: {DASHES}")
            others.append(argument.removeprefix("--"))
        elif not (value := value if equals else next(remaining, "")):
            raise CompleteSplatError(f"{name}: lacks its value; give {name} VALUE")
        elif name == EXPORT:
            others.append(f"export={quoted(value)}")
        elif value not in CHOICES.get(name, (value,)):  # -i, say, which means an image elsewhere
            raise CompleteSplatError(f"{name} {printable(value, SHORT)}: {DASHES}")
        else:
            flags.append(f"{name}={value}")
    return flags, others


def for_hydra(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return flags and settings as Hydra reads them, the flags first.

    `data import DIR` is short for `data_task=import folder=DIR`, `predict A B` for `image=[A,B]`, `view PATH` for
    `path=PATH`, and `new KIND NAME` for `kind=KIND name=NAME`. An existing file's name is taken literally: `a,b.jpg`;
    `~/` is the user's home.

    Raises:
        CompleteSplatError: a flag lacks its value, there are too many words, a setting is given as a word and by `=`, a
            word is no setting, a value cannot be read, several values come without `-m`, or `out=` is empty.
    """
    flags, others = split_flags(arguments)
    if verb in WORDS:
        others = _with_words(verb, others)
    elif verb in TASKS and others and "=" not in others[0]:
        task = f"{verb} {others[0]}"
        words = others[1:]
        others = [f"{verb}_task={others[0]}", *(_with_words(task, words) if task in WORDS else words)]
    settings = [_with_file(argument) for argument in others]
    for argument in settings:
        _refuse_unreadable(argument, any(flag in SWEEP for flag in flags))
    return [*flags, *settings]


def _with_words(verb: str, arguments: Sequence[str]) -> list[str]:
    """Rewrite words as values of the settings in `WORDS`. A word contains no `=`, or is the name of a file."""
    words = [word for word in arguments if ("=" not in word and not word.startswith("~")) or os.path.isfile(word)]
    settings = [argument for argument in arguments if argument not in words]
    keys = WORDS[verb]
    if twice := [key for key in keys if words and any(setting.startswith(f"{key}=") for setting in settings)]:
        raise CompleteSplatError(f"give files by their names or as {twice[0]}=, not both: {printable(words[0], SHORT)}")
    if verb == "predict" and len(words) > 1:
        return [f"image=[{','.join(map(quoted, words))}]", *settings]
    if len(words) > len(keys):
        wanted = " and ".join(f"one {key}" for key in keys)
        raise CompleteSplatError(f"give {wanted}, not {printable(' '.join(words), SHORT)}")
    return [f"{key}={quoted(word)}" for key, word in zip(keys, words, strict=False)] + settings


def _with_file(argument: str) -> str:
    key, equals, value = argument.partition("=")
    if equals and value.startswith("~/"):  # shells leave it as it is behind `=`
        return f"{key}={quoted(os.path.expanduser(value))}"
    if not equals or not (os.path.exists(value) or (key == "out" and PLAIN.fullmatch(value))):
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
    if equals and not key:
        raise CompleteSplatError(f"{printable(argument, SHORT)}: settings are key=value, without spaces")
    if not equals and not argument.startswith("~"):
        chosen = [f"{group}={argument}" for group in groups() if argument in options(group)]
        nearest = f"; did you mean {' or '.join(chosen)}?" if chosen else did_you_mean(argument, groups())
        raise CompleteSplatError(f"{printable(argument, SHORT)}: no setting, which are given as key=value{nearest}")
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException:
        text = "['TEXT','TEXT']" if value.startswith("[") else quoted(value)
        if key == "overrides":  # each entry is an override, too
            text = "['" + value.strip("[]'") + "']"
        example = printable(f'"{key}={text}"', SHORT)
        message = f"cannot be read; a text with such characters wants quotes: {example}"
        raise CompleteSplatError(f"{printable(argument, SHORT)}: {message}") from None
    if override.is_sweep_override() and not sweep:
        message = f"several values; -m makes a run of each, and a list is {key}=[{value}]"
        raise CompleteSplatError(f"{printable(argument, SHORT)}: {printable(message, SHORT)}")
    is_out = override.key_or_group == "out" and not override.is_sweep_override()
    if is_out and (override.value() in ("", None) or isinstance(override.value(), list | dict)):
        raise CompleteSplatError(f"{argument}: names no folder; give out=DIR")
