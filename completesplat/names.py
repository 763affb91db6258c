"""Names of files that anybody may have given: shown in one line, and made into names of our own."""

import re
import unicodedata
from collections.abc import Iterable

LONGEST = 100  # bytes of UTF-8
MOST_SHOWN = 500  # characters
UNNAMED = "unnamed"
# Control characters, breaks of lines, and the surrogates that stand for bytes that are no UTF-8.
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
SEPARATORS = re.compile(r"[/\\]")


def printable(text: str) -> str:
    """The text in one line that can be printed and encoded: what cannot is written as Python writes it (`\\n`).

    Of more than 500 characters the middle is left out.
    """
    shown = UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
    return shown if len(shown) <= MOST_SHOWN else f"{shown[: MOST_SHOWN // 2 - 5]} ... {shown[-MOST_SHOWN // 2 :]}"


def safe_name(text: str, ending: str = "") -> str:
    """The name of a file or folder that is like this text and cannot lead anywhere.

    Never empty, without separators, leading dots and unprintable characters, of at most 100 bytes of UTF-8.

    Args:
        ending: comes behind it, and does not count as text: a number, say.
    """
    plain = SEPARATORS.sub("_", UNPRINTABLE.sub("_", text)).lstrip(".")
    shortened = plain.encode()[: LONGEST - len(ending)].decode(errors="ignore")
    return (shortened or UNNAMED) + ending


def folder_names(stems: Iterable[str]) -> list[str]:
    """A safe name for each stem, and for one whose name is taken, that with `_2`, `_3` and so on behind it.

    Capitals and the forms of Unicode do not tell names apart, because they do not on every file system.
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
