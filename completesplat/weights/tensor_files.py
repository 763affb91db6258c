"""Files of `torch.save`, made by anyone: tensors and plain values, in no more memory than the file has bytes.

`torch.load(weights_only=True)` runs no code of a file, but what it may call can make much of a few bytes. The pickle is
therefore read as a list of steps before it is loaded, and only the calls that `torch.save` writes are allowed.
"""

import math
import pickletools
import re
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import torch

from completesplat.errors import TensorFileError
from completesplat.schema import shown

ZIP = b"PK\3\4"
MOST_REPEATED = 2**22
"""Numbers of a tensor that has more of them than its file, because it repeats them."""
PLAIN = re.compile(
    r"torch (\w+Storage|Size|device|[a-z]\w*)|torch\._utils _rebuild_(tensor(_v[23])?|parameter)"
    r"|collections (OrderedDict|Counter)|_codecs encode"
)
"""What tensors, containers and bytes are made with. torch allows more, such as byte arrays of any length."""
NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1"}
TEXTS = {"BINUNICODE", "SHORT_BINSTRING"}
TUPLES = {"EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"}
MAPPINGS = {"EMPTY_DICT", "SETITEM", "SETITEMS"}
CALLS = {"REDUCE", "BUILD", "NEWOBJ", "BINPERSID"}
LONGEST_NAME = 16


class Step(NamedTuple):
    """An operation of a pickle, its argument, and the steps whose results it takes (kept for calls and tuples)."""

    name: str
    argument: Any = None
    inputs: tuple[Any, ...] = ()


def read_tensor_file(path: Path, mmap: bool = False) -> Any:
    """Return what `torch.save` wrote to a file, on the CPU.

    Args:
        mmap: map the tensors from the file; its checksums (CRC-32) are not compared then.

    Raises:
        TensorFileError: the file is no zip archive from its first byte on, is damaged, has records or tensors that are
            larger than itself, or holds other things than tensors and plain values.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            # From other first bytes torch reads an older form, whatever archive is at the end.
            if file.read(len(ZIP)) != ZIP:
                raise TensorFileError("not an archive of torch.save")
            file.seek(0)
            archive = torch._C.PyTorchFileReader(file)
            if sum(map(archive.get_record_size, archive.get_all_records())) > size:
                raise TensorFileError("its parts are larger than the file")
            _check_steps(archive.get_record("data.pkl"))
        if not mmap:
            _check_sums(path, size)
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except TensorFileError:
        raise
    except Exception as error:  # torch, zipfile and pickletools have many for a damaged file
        raise TensorFileError(type(error).__name__) from error


def _check_sums(path: Path, size: int) -> None:
    """Compare the archive's checksums, which torch does not."""
    with zipfile.ZipFile(path) as archive:
        if sum(record.file_size for record in archive.infolist()) > size or archive.testzip() is not None:
            raise TensorFileError("damaged: its checksum is another")


def _check_steps(pickle: bytes) -> None:
    """Refuse a pickle with a step that may make more than the file holds."""
    stack: list[Step] = []
    marks: list[int] = []
    memo: dict[int, Step] = {}
    for opcode, argument, _ in pickletools.genops(pickle):
        name, before = opcode.name, opcode.stack_before
        if name == "MARK":
            marks.append(len(stack))
        elif name.endswith("PUT"):
            memo[argument] = stack[-1]
        elif name.endswith("GET"):
            value = memo[argument]
            is_name = value.name == "GLOBAL" or (value.name in TEXTS and len(value.argument) <= LONGEST_NAME)
            stack.append(value if is_name else Step(name))
        else:
            marked = pickletools.markobject in before
            first = marks.pop() - before.index(pickletools.markobject) if marked else len(stack) - len(before)
            step = Step(name, argument, tuple(stack[first:]) if name in CALLS | TUPLES else ())
            if not _is_plain(step):
                made = next((value.argument for value in step.inputs if value.name == "GLOBAL"), argument or name)
                raise TensorFileError(f"made of {shown(made)}, not of tensors alone")
            stack[first:] = [Step(name, _length(step)) if name in CALLS else step] * len(opcode.stack_after)


def _length(step: Step) -> int:
    """Return how many numbers a storage has; 0 of other results."""
    return step.inputs[0].inputs[-1].argument if step.name == "BINPERSID" else 0


def _is_plain(step: Step) -> bool:
    """Whether `torch.save` writes such a step: its arguments stand beside it, so that nothing large is copied often."""
    match step:
        case Step("GLOBAL"):
            return PLAIN.fullmatch(step.argument) is not None
        case Step("BUILD", _, (_, state)):
            return state.name in MAPPINGS
        # The archive's reader takes no notice of capitals: other keys could name one record many times.
        case Step("BINPERSID", _, (Step("TUPLE", _, (_, Step("GLOBAL"), key, _, length)),)):
            return key.name in TEXTS and re.fullmatch("[0-9]+", key.argument) is not None and length.name in NUMBERS
        case Step("REDUCE", _, (Step("GLOBAL", function), arguments)) if arguments.name in TUPLES:
            return _is_plain_call(function, arguments.inputs)
    return step.name not in CALLS


def _is_plain_call(function: str, arguments: tuple[Step, ...]) -> bool:
    """Whether a call makes no more than what its arguments are in the file."""
    match function.split()[1], arguments:
        case "OrderedDict", ():
            return True
        case "Counter", (counts,):
            return counts.name in MAPPINGS
        case "Size", (sizes,):
            return sizes.name in TUPLES
        case "device", (place, *index):
            return place.name in TEXTS and all(number.name in NUMBERS for number in index)
        case "encode", (text, codec):
            # Of other codecs some make twice as many bytes, as often as they are asked.
            return text.name in TEXTS and codec == Step(codec.name, "latin1")
        case "_rebuild_parameter", _:
            return True
        case "_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_tensor_v3", (Step("BINPERSID", length), _, sizes, *_):
            if any(size.name not in NUMBERS for size in sizes.inputs):
                return False
            if math.prod(size.argument for size in sizes.inputs) > max(length, MOST_REPEATED):
                raise TensorFileError("a tensor is larger than the file")
            return sizes.name in TUPLES
    return False
