"""File names from strangers: forms to print in one line, and safe names for files that the program writes."""

import re
import unicodedata
from collections.abc import Iterable

LONGEST = 100  # bytes of UTF-8
MOST_SHOWN = 500  # characters
UNNAMED = "unnamed"
# Control characters, line breaks, and the surrogates that stand for bytes that are not UTF-8.
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
SEPARATORS = re.compile(r"[/\\]")


def printable(text: str) -> str:
    """Return one line to print: escape unprintable characters as in Python (`\\n`), omit the middle of a long text."""
    line = UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)
    return line if len(line) <= MOST_SHOWN else f"{line[: MOST_SHOWN // 2 - 5]} ... {line[-MOST_SHOWN // 2 :]}"


def safe_name(text: str, ending: str = "") -> str:
    """Return a name for a file or folder that resembles the text and cannot lead to another folder.

    It is never empty, has no separators, leading dots or unprintable characters, and at most 100 bytes of UTF-8.
    `ending`, such as a number, is added to a name that is not empty without it.
    """
    plain = SEPARATORS.sub("_", UNPRINTABLE.sub("_", text)).lstrip(".")
    shortened = plain.encode()[: LONGEST - len(ending)].decode(errors="ignore")
    return (shortened or UNNAMED) + ending


def folder_names(stems: Iterable[str]) -> list[str]:
    """Return a safe name for each stem, with `_2`, `_3` and so on behind names that are taken.

    Names that differ only in case or Unicode form count as equal, because they are equal on some file systems.
    """
    names: list[str] = []
    taken: set[str] = set()
    for stem in stems:
        name, number = safe_name(stem), 2
        while (key := unicodedata.normalize("NFC", name).casefold()) in taken:
            name, number = safe_name(stem, f"_{number}"), number + 1
        taken.add(key)
        names.append(name)
    return names
