"""Remote packed store (http, https, s3, gs, hf, ...): fsspec fetches a shard when it is first read.

Fetched files lie in a local folder, which is read memory-mapped like any packed store.
"""

import hashlib
import os
from pathlib import Path

from filelock import FileLock

from completesplat.data.packed.manifest import MANIFEST, Shard
from completesplat.data.validation import ChangedFile, MissingFile
from completesplat.files import atomic_path
from completesplat.weights import sha256_of

ADDRESS = "address.txt"


def local_root(root: str) -> Path:
    """Return a local folder as it is; for an address, fetch the manifest into a folder below `COMPLETESPLAT_CACHE`.

    A store that was made again at the same address gets another folder, which depends on the manifest's digest.

    Raises:
        DataError: nothing can be fetched from the address.
    """
    if "://" not in root:
        return Path(root)
    place = os.environ.get("COMPLETESPLAT_CACHE", "~/.cache/completesplat")
    folder = Path(place).expanduser() / "stores" / _digest(root.encode())
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock"):
        _get(root, MANIFEST, folder / MANIFEST)
        store = folder / _digest((folder / MANIFEST).read_bytes())
        store.mkdir(exist_ok=True)
        for name, content in ((ADDRESS, root.encode()), (MANIFEST, (folder / MANIFEST).read_bytes())):
            with atomic_path(store / name) as temporary:
                temporary.write_bytes(content)
    return store


def address_of(root: Path) -> str | None:
    """Return the address of a folder's shards; None for a store that was made or copied here."""
    return (root / ADDRESS).read_text() if (root / ADDRESS).is_file() else None


def fetched(address: str, shard: Shard, path: Path) -> Path:
    """Return the local file of a shard; if it is missing, one process fetches it while the others wait.

    Raises:
        MissingFile: the shard cannot be fetched.
        ChangedFile: its checksum differs from the manifest's.
    """
    if path.is_file():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        if not path.is_file():
            with atomic_path(path, size=shard.bytes) as temporary:
                _get(address, shard.file, temporary)
                if sha256_of(temporary) != shard.sha256:
                    raise ChangedFile("its checksum is not that of the manifest", f"{address}/{shard.file}")
    return path


def _get(address: str, name: str, path: Path) -> None:
    import fsspec  # a slow import

    try:
        files, folder = fsspec.core.url_to_fs(address.rstrip("/"))
        files.get_file(f"{folder}/{name}", str(path))
    except Exception as error:  # each kind of store raises other exceptions
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingFile(f"cannot be fetched ({reason})", f"{address}/{name}") from error


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
