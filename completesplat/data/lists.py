"""Lists of scenes by name, one a line: those of the protocols in `conf/evaluation/lists`, or a user's own."""

from pathlib import Path

from completesplat.data.validation import read_text
from completesplat.errors import BadAnnotation, MissingFile
from completesplat.settings.options import conf_folder

FOLDER = "evaluation/lists"


def listed_names(chosen: str) -> list[str]:
    """Return the names of a list: a file, or the name of one of the package's.

    Raises:
        MissingFile: there is no such file, nor such a list.
        BadAnnotation: the list is empty, or has a name twice.
    """
    folder = conf_folder() / FOLDER
    path = folder / f"{chosen}.txt"
    if not path.is_file():
        path = Path(chosen)
    if not path.is_file():
        known = ", ".join(sorted(known.stem for known in folder.glob("*.txt")))
        raise MissingFile(f"no such file, nor a list of the package ({known})", chosen)
    names = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if not names or len(set(names)) < len(names):
        raise BadAnnotation("must have one name a line, each once", str(path))
    return names
