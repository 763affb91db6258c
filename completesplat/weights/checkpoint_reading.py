"""Reading of checkpoints and other `torch.save` files: plain tensors, in no more memory than the file has bytes.

`torch.load(weights_only=True)` runs no code of a file, but even with `mmap=True` it takes 2 GB for a file of 500 bytes
that calls `bytearray(2**31)`. Therefore a dry run first adds up what the calls of a file would make, and what its
tensors would repeat. None of this needs Lightning.
"""

import io
import logging
import math
import pickle
import pickletools
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from completesplat.errors import TensorFileError, WeightsError
from completesplat.wording import SHORT, printable

ZIP = b"PK\3\4"
DIRECTORY = 0x10  # attribute of a record
MOST_REPEATED = 2**22  # numbers that all tensors together may have beyond the bytes of the file
BYTES_PER_ENTRY = 100  # of a dictionary or tuple
MOST_AXES = 64  # of a tensor of torch
PLAIN = re.compile(
    r"torch (\w+Storage|Size|device|[a-z]\w*)|torch\._utils _rebuild_(tensor(_v[23])?|parameter)"
    r"|collections (OrderedDict|Counter)|_codecs encode"
)
"""Names that build tensors, containers and bytes. torch allows more, such as byte arrays of any length."""
MOST_NAMED = 5  # tensors in a message

logger = logging.getLogger(__name__)


def read_tensor_file(path: Path, mmap: bool = False) -> Any:
    """Return what `torch.save` wrote to a file, on the CPU.

    Args:
        mmap: map the tensors from the file; its checksums (CRC-32) are not compared then.

    Raises:
        TensorFileError: the file is no zip archive from its first byte on, is damaged, has records or tensors that are
            larger than itself, or holds anything but tensors and plain values.
    """
    with _refusing_damage():
        _DryRun(_checked_pickle(path, sums=not mmap), path.stat().st_size + MOST_REPEATED).load()
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)


@contextmanager
def _refusing_damage() -> Iterator[None]:
    try:
        yield
    except TensorFileError:
        raise
    except Exception as error:  # torch, zipfile and pickle raise many kinds for a damaged file
        raise TensorFileError(f"damaged, cut off or of another format: {type(error).__name__}") from error


def _checked_pickle(path: Path, sums: bool) -> bytes:
    """Return the pickle in an archive whose records are whole.

    Args:
        sums: compare the records' checksums (CRC-32), which torch does not.
    """
    with path.open("rb") as file, zipfile.ZipFile(file) as records:
        # If a file starts with other bytes, torch reads an older format, even if an archive follows.
        file.seek(0)
        if file.read(len(ZIP)) != ZIP:
            raise TensorFileError("not an archive of torch.save")
        archive = torch._C.PyTorchFileReader(str(path))
        listed = records.infolist()
        if sum(record.file_size for record in listed) > path.stat().st_size:
            raise TensorFileError("its parts are larger than the file")
        # torch and zipfile may find different lists of records in a file; not if both have the first byte's record.
        places = [archive.get_record_header_offset(name) for name in archive.get_all_records()]  # type: ignore[attr-defined]
        if places != [record.header_offset for record in listed] or 0 not in places:
            raise TensorFileError("damaged: it has two lists of its parts")
        # Of a directory, torch returns memory that nobody has written to.
        if any(record.external_attr & DIRECTORY for record in listed):
            raise TensorFileError("damaged: a record that is a directory")
        if sums and records.testzip() is not None:
            raise TensorFileError("damaged: its checksum is another")
        return archive.get_record("data.pkl")


class _Made:
    """Placeholder for a tensor, a storage or another result of a call."""

    def __setitem__(self, key: object, value: object) -> None: ...


class _DryRun(pickle._Unpickler):
    """Reading of a pickle that makes no tensors but counts their bytes.

    It raises TensorFileError if there are more than `most`. The unpickler in C is not used, because it reserves memory
    for any index that a file names.
    """

    # Later operations reserve memory for any length, and torch.save does not write them.
    dispatch: ClassVar = {
        code: pickle._Unpickler.dispatch[code]
        for code in (ord(operation.code) for operation in pickletools.opcodes if operation.proto <= 2)
    }

    def __init__(self, content: bytes, most: int) -> None:
        super().__init__(io.BytesIO(content), encoding="utf-8")
        self.left = most

    def find_class(self, module: str, name: str) -> Callable[..., _Made]:
        if PLAIN.fullmatch(f"{module} {name}") is None:
            raise TensorFileError(f"made of {printable(f'{module} {name}', SHORT)}, not of tensors alone")
        return partial(self._call, name)

    def persistent_load(self, pid: Any) -> _Made:
        _, _, key, _, length = pid
        # The archive's reader ignores case, so keys with letters could name one record many times.
        if re.fullmatch("[0-9]+", key) is None or type(length) is not int:
            raise TensorFileError(f"made of storage {printable(key, SHORT)}, not of tensors alone")
        return _Made()

    def load_build(self) -> None:
        """Count the entries of an object's state, as an ordered dictionary has."""
        state = self.stack.pop()  # type: ignore[attr-defined]
        if type(state) is not dict or not all(type(key) is str for key in state):
            raise TensorFileError("made of unusual states, not of tensors alone")
        self._count(BYTES_PER_ENTRY * len(state))

    dispatch[pickle.BUILD[0]] = load_build  # type: ignore[assignment]

    def _call(self, function: str, *arguments: Any) -> _Made:
        match function, arguments:
            case ("OrderedDict", ()) | ("device", (str(), *_)) | ("_rebuild_parameter", (_Made(), *_)):
                pass
            case ("Counter", (dict() as entries,)) | ("Size", (tuple() as entries,)):
                self._count(BYTES_PER_ENTRY * len(entries))
            case ["encode", (str() as text, "latin1")]:  # some other codecs double the bytes each time they are called
                self._count(len(text))
            case ["_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_tensor_v3", (_Made(), _, tuple() as sizes, *_)]:
                if len(sizes) > MOST_AXES or not all(type(size) is int for size in sizes):
                    raise TensorFileError("made of unusual sizes, not of tensors alone")
                self._count(abs(math.prod(sizes)))
            case _:
                raise TensorFileError(f"made of {function} of unusual values, not of tensors alone")
        return _Made()

    def _count(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise TensorFileError("its content is larger than the file")


def check_whole(path: Path) -> None:
    """Raise WeightsError if a checkpoint has changed since it was written."""
    try:
        with _refusing_damage():
            _checked_pickle(path, sums=True)
    except TensorFileError as error:
        raise WeightsError(f"{path}: not a readable checkpoint ({error})") from error


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint's contents.

    Raises:
        WeightsError: the file is missing, damaged, no checkpoint of plain tensors, made to take more memory than it has
            bytes, or its weights are not finite.
    """
    if not Path(path).is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    try:
        contents: dict[str, Any] = read_tensor_file(Path(path))
        name = not_finite(contents["state_dict"])
    except WeightsError:
        raise
    except Exception as error:
        reason = error if isinstance(error, TensorFileError) else type(error).__name__
        raise WeightsError(f"{path}: not a readable checkpoint ({reason})") from error
    if name is not None:
        raise WeightsError(f"{path}: {name} is not finite")
    return contents


def not_finite(weights: Mapping[str, object]) -> str | None:
    """Return the name of the first tensor that holds NaN or infinities, if there is one."""
    return next((n for n, x in weights.items() if isinstance(x, Tensor) and not x.isfinite().all()), None)


def mismatch(network: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> str | None:
    """Describe the first difference between a network's tensors and a file's, in sizes, kinds or names, if any.

    Floats of any precision are one kind, because they are converted; other kinds would be cast in silence.
    """
    pairs = {name: (_described(weights[name]), _described(x)) for name, x in network.items() if name in weights}
    different = (f"{name} is {there} there and {here} here" for name, (there, here) in pairs.items() if there != here)
    missing = (f"{name} is missing there" for name in network if name not in weights)
    needless = (f"{name} has no place here" for name in weights if name not in network)
    return next(chain(different, missing, needless), None)


def _described(tensor: Tensor) -> str:
    kind = "" if tensor.is_floating_point() else f" of {tensor.dtype}"
    return f"{list(tensor.shape)}{kind}"


def load_part(module: nn.Module, path: str | Path, prefix: str) -> None:
    """Load a checkpoint's weights below `prefix` into a module; raise WeightsError unless all are present and fit."""
    weights = read_checkpoint(path)["state_dict"]
    part = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    load_tensors(module, part, path)


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], path: str | Path, strict: bool = True) -> None:
    """Load the tensors of a file into a module.

    Args:
        path: the file, for messages.
        strict: refuse tensors that only the file has or only the module; false: log their names.

    Raises:
        WeightsError: a tensor has another size or type, or only one of the two has it.
    """
    network = module.state_dict()
    if not strict:
        _log_difference(network, tensors, path)
        tensors = {name: tensor for name, tensor in tensors.items() if name in network}
        network = {name: tensor for name, tensor in network.items() if name in tensors}
    difference = mismatch(network, tensors)
    if difference is not None:
        raise WeightsError(f"{path}: weights of another architecture: {difference}")
    module.load_state_dict(tensors, strict=strict)


def _log_difference(network: Mapping[str, Tensor], weights: Mapping[str, Tensor], path: str | Path) -> None:
    """Warn of tensors that only a network has, or only a file."""
    missing = [name for name in network if name not in weights]
    needless = [name for name in weights if name not in network]
    if missing:
        named = ", ".join(missing[:MOST_NAMED])
        logger.warning("%s: %d tensors are missing there and keep initial values: %s", path, len(missing), named)
    if needless:
        named = ", ".join(needless[:MOST_NAMED])
        logger.warning("%s: %d tensors have no place here: %s", path, len(needless), named)
