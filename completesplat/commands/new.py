"""`completesplat new`: a first version of a user's own part or package, with settings and a passing test."""

import keyword
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig

from completesplat.errors import CompleteSplatError
from completesplat.files import write_text
from completesplat.settings.options import conf_folder

TEMPLATES = Path(__file__).parents[1] / "templates"
KINDS = ("loss", "metric", "rasterizer", "encoder", "callback", "dataset", "ablation", "experiment", "package")
# Command in a template that uses the new part: `completesplat VERB WORDS KEY=VALUE ...`.
USE = re.compile(r"completesplat \w+[\w ]*( [+\w.]+=[\w.]*\w)+")
FILE = re.compile(r"^=== (\S+)\n", re.MULTILINE)  # line of a template that names the file which follows


def run(config: DictConfig) -> None:
    """Write the part's files into the working folder.

    Print their names and the commands that test and use them.
    """
    kind = str(config.kind)
    name = str(config.name)
    files = new_files(kind, name)
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
        print(path)
    first_use = next(USE.finditer("".join(files.values())))[0]
    needed = "" if find_spec("pytest") else " (needs pip install pytest)"
    tests = f"test_{kind}_{name}.py"
    if kind == "package":
        tests = name
        print("first:", shlex.join([sys.executable, "-m", "pip", "install", "--editable", name]))
    print("next:", shlex.join([sys.executable, "-m", "pytest", tests]) + needed)
    print("then:", first_use)


def new_files(kind: str, name: str) -> dict[Path, str]:
    """Return a new part's files by path.

    Raises:
        CompleteSplatError: kind or name is unfit, or a file exists.
    """
    if kind not in KINDS:
        raise CompleteSplatError(f"kind={kind}: choose one of {', '.join(KINDS)}")
    if not name.isidentifier() or keyword.iskeyword(name) or name.startswith("_"):
        raise CompleteSplatError(f"name={name}: must be a Python name: letters, digits and underscores")
    files = filled_template(kind, name)
    for path in files:
        if path.exists():
            raise CompleteSplatError(f"{path}: exists already; choose another name")
        _, conf, option = path.as_posix().rpartition("conf/")
        if conf and (conf_folder() / option).is_file():
            raise CompleteSplatError(f"name={name}: the package has conf/{option}; choose another name")
    # Python searches the working folder last, so it would import the other module of this name.
    if (kind == "package" or Path(f"{name}.py") in files) and _is_module(name):
        raise CompleteSplatError(f"name={name}: a module has this name; choose another name")
    return files


def _is_module(name: str) -> bool:
    """Return whether Python finds a module of this name. A folder without modules, such as a new clone, is none."""
    spec = find_spec(name)
    return spec is not None and spec.origin is not None


def filled_template(kind: str, name: str) -> dict[Path, str]:
    """Return the files of a kind's template by path, with the part's name in them."""
    text = (TEMPLATES / f"{kind}.txt").read_text()
    text = text.replace("@opened@\n", (TEMPLATES / "_opened.txt").read_text())
    class_name = "".join(word.capitalize() for word in name.split("_"))
    text = text.replace("@name@", name).replace("@Name@", class_name)
    _, *parts = FILE.split(text)  # paths and contents in turn
    files = {}
    for path, content in zip(parts[::2], parts[1::2], strict=True):
        files[Path(path)] = content.strip("\n") + "\n"
    return files
