"""Sending of files to a repository on the Hugging Face hub, with a token and after a yes."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.filesize import decimal

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.weights import HUB_ID, first_line
from completesplat.wording import SHORT, counted, printable

if TYPE_CHECKING:
    from huggingface_hub import HfApi, ModelInfo

GRAPHS = "try"  # folder of ONNX graphs in a repository
Files = Mapping[str, Path | bytes]
"""Files to send, by their paths in the repository."""


def check_destination(repository: str) -> None:
    """Check the name of a repository and that there is a token, before anything is made for it.

    Raises:
        CompleteSplatError: the name is not OWNER/NAME, or there is no token.
    """
    from huggingface_hub import get_token

    place = HUB_ID.fullmatch(repository)
    if place is None or place["repository"] != repository:
        raise CompleteSplatError(
            f"{printable(repository, SHORT)}: give the repository as OWNER/NAME, such as me/fruits"
        )
    if get_token() is None:
        advice = (
            "run `hf auth login`, or set HF_TOKEN to a token that may write (https://huggingface.co/settings/tokens)"
        )
        raise CompleteSplatError(f"{repository}: there is no token for the Hugging Face hub; {advice}")


def send(repository: str, files: Files, private: bool, confirm: bool) -> str:
    """Send files in one commit, and make the repository if there is none.

    Graphs of an earlier commit that are not sent again are removed, because they belong to other weights.

    Args:
        private: make a new repository private.
        confirm: send without a question; otherwise ask on the terminal.

    Returns:
        The address of the repository.

    Raises:
        CompleteSplatError: there is no token, no yes, or the repository is public although `private` is asked for.
        WeightsError: the hub cannot be reached, or refuses.
    """
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi

    check_destination(repository)
    api = HfApi()
    before = _repository(api, repository)
    if before is not None and private and not before.private:
        advice = "make it private in its settings on the hub, or choose another name"
        raise CompleteSplatError(f"{repository}: is public already, which private=true does not change; {advice}")
    if not confirm:
        seen = "private" if private or (before is not None and before.private) else "public"
        state = f"is made, {seen}" if before is None else f"exists, {seen}; its files of these names are replaced"
        _ask(repository, files, state)
    operations: list[CommitOperationAdd | CommitOperationDelete] = []
    for path, content in files.items():
        operations.append(CommitOperationAdd(path, content))
    there = [] if before is None else [sibling.rfilename for sibling in before.siblings or ()]
    for path in there:
        if path.startswith(f"{GRAPHS}/") and path not in files:
            operations.append(CommitOperationDelete(path))
    try:
        if before is None:
            api.create_repo(repository, private=private)
        api.create_commit(repository, operations, commit_message="Weights of completesplat")
    except Exception as error:  # from the hub, its HTTP library or the file system
        raise _refused(repository, error) from error
    return f"{api.endpoint}/{repository}"


def _repository(api: "HfApi", repository: str) -> "ModelInfo | None":
    """Return what the hub knows of a repository, or None if it does not exist."""
    from huggingface_hub.errors import RepositoryNotFoundError

    try:
        return api.model_info(repository)
    except RepositoryNotFoundError:
        return None
    except Exception as error:  # from the hub or its HTTP library
        raise _refused(repository, error) from error


def _ask(repository: str, files: Files, state: str) -> None:
    """Ask on the terminal whether to send; raise CompleteSplatError without a yes, or if there is no terminal.

    Args:
        state: whether the repository exists, and who sees it.
    """
    names = ", ".join(files)
    if not sys.stdin.isatty():
        reason = "nothing was sent, because that needs a yes: confirm=true says it"
        raise CompleteSplatError(f"{repository}: {reason} for {names}")
    size = sum(len(content) if isinstance(content, bytes) else content.stat().st_size for content in files.values())
    print(f"Files: {names}\n{repository} {state}.")
    try:
        answer = input(f"Send {counted(len(files), 'file')} ({decimal(size)}) to {repository}? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise CompleteSplatError(f"{repository}: nothing was sent")


def _refused(repository: str, error: Exception) -> WeightsError:
    return WeightsError(f"{repository}: cannot be sent to the hub ({printable(first_line(error))})")
