"""Programs that stand in for `splat-transform` and `npx`."""

from pathlib import Path

from support import write_program

# Notes its arguments beside itself and copies the last but one to the last.
COPY = """
echo "$@" >> "$0.log"
[ "$1" = --version ] && exit 0
for last; do source=$target; target=$last; done
cp "$source" "$target"
"""


def install(folder: Path, name: str, script: str = COPY) -> Path:
    """An executable shell script in a folder for PATH."""
    folder.mkdir(exist_ok=True)
    return write_program(folder / name, script)


def calls(program: Path) -> list[str]:
    """The arguments of every call, in order."""
    log = Path(f"{program}.log")
    return log.read_text().splitlines() if log.exists() else []
