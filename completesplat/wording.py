"""Text for messages (one printable line, counted nouns), safe names for files and folders, and sorting by numbers."""

import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

LONGEST = 100  # bytes of a file name, in UTF-8
MOST_SHOWN = 500  # characters of a message
SHORT = 120  # characters of a value in a message
# Control characters, line breaks, changes of direction, and the surrogates that stand for bytes that are not UTF-8.
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(value: object, most: int = MOST_SHOWN) -> str:
    """Return one line of at most `most` characters to print, without control characters.

    Unprintable characters are escaped as in Python (`\\n`), and the middle of a long text is omitted.
    """
    line = UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode(), str(value))
    return line if len(line) <= most else f"{line[: most // 2 - 5]} ... {line[-most // 2 :]}"


def counted(count: int, noun: str) -> str:
    """Return a number and a noun whose plural ends in s: `1 scene`, `2 scenes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def by_numbers(path: Path) -> list[tuple[int, str, str]]:
    """Return a key that sorts paths with numbers by their values: `r_2` before `r_03` before `r_10`."""
    key: list[tuple[int, str, str]] = []
    for part in re.split(r"([0-9]+)", str(path)):
        if part.isdecimal():
            digits = part.lstrip("0")
            key.append((len(digits), digits, part))
        else:
            key.append((-1, part, part))
    return key


def safe_name(text: str, ending: str = "") -> str:
    """Return a name for a file or folder that resembles the text and cannot lead to another folder.

    It is never empty, has no separators, leading dots or unprintable characters, and at most 100 bytes of UTF-8.
    `ending`, such as a number, is added to a name that is not empty without it.
    """
    plain = re.sub(r"[/\\]", "_", UNPRINTABLE.sub("_", text)).lstrip(".")
    shortened = plain.encode()[: LONGEST - len(ending)].decode(errors="ignore")
    return (shortened or "unnamed") + ending


def folder_names(stems: Iterable[str]) -> list[str]:
    """Return a safe name for each stem, with `_2`, `_3` and so on behind names that are taken.

    Names that differ only in case or Unicode form count as equal, because they are equal on some file systems.
    """
    names: list[str] = []
    taken: set[str] = set()
    for stem in stems:
        name = safe_name(stem)
        number = 2
        while _folded(name) in taken:
            name = safe_name(stem, f"_{number}")
            number += 1
        taken.add(_folded(name))
        names.append(name)
    return names


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
