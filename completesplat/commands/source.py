"""Which state of the source a run was made with."""

import subprocess
from pathlib import Path


def git_commit() -> str | None:
    """The commit of the source, marked when there are changes on top; None where there is no repository."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, check=True).stdout

    try:
        if not git("ls-files", "."):  # an installed package inside somebody else's repository
            return None
        return git("rev-parse", "HEAD").strip() + ("-dirty" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
