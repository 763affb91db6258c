"""Arguments behind a verb, as Hydra reads them: a task's name, file names as words, and flags before settings."""

import os
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from completesplat.errors import CompleteSplatError
from completesplat.settings.options import TASKS
from completesplat.wording import SHORT, printable

WORDS = {"predict": ("image",), "view": ("path",), "new": ("kind", "name"), "data import": ("folder",)}
"""By verb, or verb and task, the settings whose values are given as words without `=`."""
PATHS = (
    "out",
    "root",
    "folder",
    "image",
    "mask",
    "path",
    "cameras",
    "weights",
    "ckpt",
    "ckpt_path",
    "checkpoint",
    "autoreconstructor_checkpoint",
    "pretrained",
    "latent_cache",
    "runs",
    "export",
)
"""Last parts of the names of settings for files and folders, whose names may look like numbers."""
TEXTS = ("method", "wandb.notes")
"""Settings that are free texts: commas, brackets and spaces in them mean nothing."""
GROUPS_TO_LEAVE_OUT = ("logger", "callbacks", "hparams_search", "debug")
"""Config groups that `group=null` leaves out."""
SWEEP = ("-m", "--multirun")
HYDRA_FLAGS = (*SWEEP, "--resolve")
FLAGS_WITH_VALUE = ("--cfg", "--config-dir")
SHOWN_CONFIGS = ("job", "hydra", "all")


def quoted(text: str) -> str:
    """Quote a text so that Hydra takes every character literally, without lists or references to other settings."""
    # A reference is marked as text by a backslash, before which other backslashes have to be doubled.
    parts = text.split("${")
    for index, part in enumerate(parts[:-1]):
        backslashes = len(part) - len(part.rstrip("\\"))
        parts[index] = part + "\\" * (backslashes + 1)
    return QuotedString(text="${".join(parts), quote=Quote.single).with_quotes()


def for_hydra(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return flags and settings as Hydra reads them, the flags first, because Hydra takes none between settings.

    `data import DIR` is short for `data_task=import folder=DIR`, `predict A B` for `image=[A,B]`, `view PATH` for
    `path=PATH`, and `new KIND NAME` for `kind=KIND name=NAME`. `logger=null`, and others in `GROUPS_TO_LEAVE_OUT`,
    leave the group out.

    Raises:
        CompleteSplatError: Hydra has no such flag, a flag lacks its value, or there are too many words.
    """
    flags, others = split_flags(arguments)
    command = verb
    task = []
    if verb in TASKS and others and "=" not in others[0]:
        command = f"{verb} {others[0]}"
        task = [f"{verb}_task={others[0]}"]
        others = others[1:]
    if command in WORDS:
        others = with_words(command, others)
    return [*flags, *task, *(_as_text(_left_out(argument)) for argument in others)]


def _left_out(argument: str) -> str:
    """Return Hydra's words for a group that is left out, which it does not read as `group=null`."""
    group, _, option = argument.partition("=")
    return f"~{group}" if group in GROUPS_TO_LEAVE_OUT and option in ("null", "[]") else argument


def _as_text(argument: str) -> str:
    """Quote a free text, and a path that Hydra would read as a number or as true (`out=1e3`, `out=NAN`)."""
    key, equals, value = argument.partition("=")
    if key in TEXTS and value not in ("", "null") and value[0] not in "'\"":
        return f"{key}={quoted(value)}"
    if not equals or key.lstrip("+").rpartition(".")[2] not in PATHS:
        return argument
    try:
        read = OverridesParser.create().parse_override(argument).value()
    except HydraException:  # Hydra reports what it cannot read
        return argument
    return f"{key}={quoted(value)}" if isinstance(read, bool | int | float) else argument


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate Hydra's flags, with their values, from the other arguments."""
    flags = []
    others = []
    remaining = iter(arguments)
    for argument in remaining:
        name, equals, value = argument.partition("=")
        if not argument.startswith("-"):
            others.append(argument)
        elif argument in HYDRA_FLAGS:
            flags.append(argument)
        elif name in FLAGS_WITH_VALUE:
            flags.append(f"{name}={value if equals else next(remaining, '')}")
        else:
            message = "no flag; settings are key=value, such as out=DIR, and files are given by their names"
            raise CompleteSplatError(f"{printable(argument, SHORT)}: {message}")
    for flag in flags:
        name, _, value = flag.partition("=")
        if name in FLAGS_WITH_VALUE and not value:
            raise CompleteSplatError(f"{name}: lacks its value; give {name} VALUE")
        if name == "--cfg" and value not in SHOWN_CONFIGS:
            raise CompleteSplatError(f"{printable(flag, SHORT)}: choose one of {', '.join(SHOWN_CONFIGS)}")
    return flags, others


def with_words(command: str, arguments: Sequence[str]) -> list[str]:
    """Rewrite words as values of the settings in `WORDS`. A word contains no `=`, or is the name of a file."""
    words = [argument for argument in arguments if is_word(argument)]
    settings = [argument for argument in arguments if not is_word(argument)]
    keys = WORDS[command]
    if command == "predict" and len(words) > 1:
        return [f"image=[{','.join(map(quoted, words))}]", *settings]
    if len(words) > len(keys):
        wanted = " and ".join(f"one {key}" for key in keys)
        raise CompleteSplatError(f"give {wanted}, not {printable(' '.join(words), SHORT)}")
    named = [f"{key}={quoted(word)}" for key, word in zip(keys, words, strict=False)]
    return [*named, *settings]


def is_word(argument: str) -> bool:
    """Return whether an argument is no setting (`key=value`) and removes none (`~key`), or is the name of a file."""
    return ("=" not in argument and not argument.startswith("~")) or os.path.isfile(argument)
