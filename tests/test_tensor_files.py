"""Files of `torch.save` that strangers made, for each of their readers: read as plain tensors in bounded memory."""

import pickle
import struct
import zipfile
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from fuzzing import CLEAR, bounded

from completesplat.baselines.splatter_image.model import STATE, read_tensors
from completesplat.data.realestate10k.clips import read_chunk
from completesplat.errors import CompleteSplatError, TensorFileError
from completesplat.weights.checkpoint_reading import read_checkpoint, read_tensor_file

pytestmark = pytest.mark.skipif(not CLEAR.exists(), reason="memory is measured as Linux tells it")
READERS: dict[str, Callable[[Path], Any]] = {}
READERS |= {"checkpoint": read_checkpoint, "chunk": read_chunk, "published": read_tensors}
MEBIBYTE = 2**20


def contents(value: Any, *_: object) -> Any:
    """Contents that all readers but that of chunks take, with a value in them."""
    return {"state_dict": {"a": torch.ones(2)}, STATE: {"a": torch.ones(2)}, "more": value}


def clips(value: Any) -> Any:
    return [{"key": "a", "more": value}]


def write(path: Path, pickled: bytes, records: Mapping[str, bytes] = {"data/0": bytes(8)}, attribute: int = 0) -> None:
    """Write an archive as torch does, with a pickle and records of the test's making, these with an attribute."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {"data.pkl": pickled, "byteorder": b"little", "version": b"3\n", **records}.items():
            record = zipfile.ZipInfo(f"archive/{name}")
            record.external_attr = attribute if name in records else 0
            archive.writestr(record, content)


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def number(value: int) -> bytes:
    return b"\x8a\x06" + value.to_bytes(6, "little")


def named(name: str) -> bytes:
    module, _, name = name.rpartition(".")
    return f"c{module}\n{name}\n".encode()


def called(name: str, *arguments: bytes) -> bytes:
    """Instructions of a pickle for a value: what a call makes."""
    return named(name) + b"(" + b"".join(arguments) + b"tR"


def doubled(times: int, codec: bytes) -> bytes:
    """Return instructions for eight bytes in hexadecimal digits, those again, and so on."""
    value = called("_codecs.encode", text("12345678"), text("latin1"))
    for _ in range(times):
        value = called("_codecs.encode", value, codec)
    return value


def kept(value: bytes, steps: Callable[[bytes], bytes], times: int) -> bytes:
    """Return instructions for a list with a large value in it, and what is made of that value again and again."""
    return b"](" + value + b"q\x07" + times * steps(b"h\x07") + b"e"


def storage(key: str = "0", length: bytes = b"K\x02") -> bytes:
    return b"(" + text("storage") + named("torch.FloatStorage") + text(key) + text("cpu") + length + b"tQ"


def tensor(size: int) -> bytes:
    """Return instructions for a tensor that repeats one number."""
    no_hooks = named("collections.OrderedDict") + b")R"
    return called(
        "torch._utils._rebuild_tensor_v2", storage(), b"K\0", number(size) + b"\x85", b"K\0\x85\x89" + no_hooks
    )


def dictionary(size: int) -> bytes:
    return b"}(" + b"".join(text(str(i)) + b"N" for i in range(size)) + b"u"


ENCODE = named("_codecs.encode")
REPEATED = tensor(2 * MEBIBYTE)
ASKS = {
    "bytearray": called("builtins.bytearray", number(2**31)),
    "FloatTensor": called("torch.FloatTensor", number(2**31)),
    "new object": named("collections.Counter") + REPEATED + b"\x85\x81",
    "hexadecimal digits": doubled(24, text("Hex-Codec")),
    "one text often": kept(text("x" * MEBIBYTE), lambda x: ENCODE + b"(" + x + text("latin1") + b"tR", 200),
    "one argument often": kept(b"(" + text("x" * MEBIBYTE) + text("latin1") + b"t", lambda x: ENCODE + x + b"R", 200),
    "one dictionary often": kept(dictionary(10_000), lambda x: named("collections.Counter") + x + b"\x85R", 400),
    "one size often": kept(b"(" + b"K\1" * 100_000 + b"t", lambda x: named("torch.Size") + x + b"\x85R", 400),
    "one state often": kept(dictionary(10_000), lambda x: named("collections.OrderedDict") + b")R" + x + b"b", 400),
    "numbers counted": called("collections.Counter", REPEATED),
    "numbers as pairs": called("collections.OrderedDict", REPEATED),
    "numbers as sizes": called("torch.Size", REPEATED),
    "numbers as a length": storage(length=tensor(2**22)),
    "numbers as a state": named("collections.OrderedDict") + b")R" + REPEATED + b"b",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "reader"), [*product(ASKS, ["checkpoint"]), ("bytearray", "chunk"), ("bytearray", "published")]
)
def test_what_asks_for_more_than_the_file_has_is_refused(tmp_path, reader, name):
    write(tmp_path / "a", b"\x80\x02" + ASKS[name] + b".")
    reason = r"made of \S[^\n]*, not of tensors alone|its content is larger than the file|of another format"
    with bounded(2**26), pytest.raises(CompleteSplatError, match=rf"^[^\n]*({reason})"):
        READERS[reader](tmp_path / "a")


def test_one_record_under_many_names_is_refused(tmp_path):
    names = ["".join(c.upper() if bits >> i & 1 else c for i, c in enumerate("abcdef")) for bits in range(64)]
    several = b"](" + b"".join(storage(name, number(MEBIBYTE)) for name in names) + b"e"
    write(tmp_path / "a", b"\x80\x02" + several + b".", {"data/abcdef": bytes(4 * MEBIBYTE)})
    with bounded(2**26), pytest.raises(CompleteSplatError, match="not of tensors alone"):
        read_checkpoint(tmp_path / "a")


@pytest.mark.parametrize("reader", READERS)
def test_an_older_form_with_an_archive_behind_it_is_refused(tmp_path, reader):
    """torch looks at the first bytes, `zipfile` at the last: the one read what the other had not checked."""
    path, value = tmp_path / "a", clips(1) if reader == "chunk" else contents(1)
    torch.save(value, path)
    archive = path.read_bytes()
    READERS[reader](path)
    torch.save(value, path, _use_new_zipfile_serialization=False)
    path.write_bytes(path.read_bytes() + archive)
    with pytest.raises(CompleteSplatError, match=r"not an archive of torch\.save"):
        READERS[reader](path)
    path.write_bytes(b"\x80\x02" + ASKS["bytearray"] + b"." + archive)
    with bounded(2**26), pytest.raises(CompleteSplatError, match=r"not an archive of torch\.save"):
        READERS[reader](path)


@pytest.mark.parametrize("reader", ["checkpoint", "chunk"])
def test_a_second_directory_of_records_does_not_hide_those_that_torch_reads(tmp_path, reader):
    """Python reads the directory before the end, torch the one that the end points to."""
    path = tmp_path / "a"
    write(path, b"\x80\x02" + ASKS["bytearray"] + b".")
    first, end = path.read_bytes()[:-22], path.read_bytes()[-22:]
    write(path, pickle.dumps(clips(1) if reader == "chunk" else contents(1)["more"], protocol=2))
    second = path.read_bytes()
    size = struct.unpack("<L", second[-10:-6])[0]
    path.write_bytes(first + second[:-10] + struct.pack("<L", size) + end[-6:])
    with bounded(2**26), pytest.raises(CompleteSplatError):
        READERS[reader](path)


@pytest.mark.parametrize("reader", ["checkpoint", "published"])
def test_records_and_tensors_that_are_larger_than_the_file_are_refused(tmp_path, reader):
    path = tmp_path / "a"
    torch.save(contents(torch.zeros(2**22)), path)
    with zipfile.ZipFile(path) as archive:
        records = {record: archive.read(record) for record in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for record, content in records.items():
            archive.writestr(record, content)
    with bounded(2**23), pytest.raises(CompleteSplatError, match="its parts are larger than the file"):
        READERS[reader](path)
    for value in (torch.zeros(1).expand(2**28), [(torch.zeros(1).expand(2**40),)]):
        torch.save(contents(value), path)
        with bounded(2**26), pytest.raises(CompleteSplatError, match="its content is larger than the file"):
            READERS[reader](path)


def test_many_tensors_that_repeat_one_are_refused_by_their_total(tmp_path):
    one, large = torch.zeros(1), torch.zeros(2**20)
    for tensors in ([one.expand(2**21) for _ in range(3)], [large.view(-1) for _ in range(12)]):
        torch.save(tensors, tmp_path / "a.pt")
        with pytest.raises(TensorFileError, match="its content is larger than the file"):
            read_tensor_file(tmp_path / "a.pt")
    torch.save({"embedding": large, "tied": large}, tmp_path / "a.pt")
    assert read_tensor_file(tmp_path / "a.pt").keys() == {"embedding", "tied"}


@pytest.mark.parametrize("reader", ["checkpoint", "published"])
def test_numbers_marked_as_a_directory_are_refused(tmp_path, reader):
    """torch takes such a record's bytes from memory that nobody has written to."""
    entries = b"".join(text(name) + b"}" + text("a") + tensor(2) + b"ss" for name in ("state_dict", STATE))
    write(tmp_path / "a", b"\x80\x02}" + entries + b".", attribute=0x10)
    with pytest.raises(CompleteSplatError, match="a record that is a directory"):
        READERS[reader](tmp_path / "a")


def of_size(size: int) -> bytes:
    """Return instructions for a tensor that says this size of itself and of its storage."""
    said = b"J" + struct.pack("<i", size)
    return tensor(2).replace(b"K\x02t", said + b"t").replace(number(2), said)


SIZES = {
    # torch compares the length of a storage with the file only where it is named first.
    "a length that is said again": (
        b"](" + tensor(2) + tensor(2**30).replace(b"K\x02t", number(2**30) + b"t") + b"e",
        "its content is larger than the file",
    ),
    "many long numbers": (
        tensor(2).replace(number(2) + b"\x85", b"(" + 50_000 * (b"\x8a\xff" + b"\x01" * 255) + b"t"),
        "unusual sizes",
    ),
    "three numbers of two": (of_size(3), "not a readable checkpoint"),
    "many numbers of two": (of_size(2**28), "not a readable checkpoint"),
}


@pytest.mark.parametrize(("value", "reason"), SIZES.values(), ids=SIZES)
def test_sizes_that_the_file_does_not_have_are_refused(tmp_path, value, reason):
    write(tmp_path / "a", b"\x80\x02}" + text("state_dict") + b"}" + text("a") + value + b"ss.")
    with bounded(2**27), pytest.raises(CompleteSplatError, match=reason):
        read_checkpoint(tmp_path / "a")


def test_plain_values_of_all_kinds_are_read(tmp_path):
    layer = torch.nn.Linear(2, 2).double()
    several = {
        "tensors": [
            *(layer.weight.data, torch.zeros(1).expand(2**10), torch.tensor(1), torch.ones(2, 3, dtype=torch.bool)),
        ],
        "shared": [layer.bias.data, layer.bias.data[:1], layer.bias.data],
        "parameter": layer.weight,
        "layer": layer.state_dict(),
        "bytes": [bytes(range(256)), b"a", b"abc", b"a"],
        "names": [
            *("a", 1, -(2**40), 1.5, None, True, (1, (2, 3))),
            *(torch.float16, torch.device("cuda", 1), torch.Size([2])),
        ],
        "counts": [Counter([3, 3, 4]), OrderedDict(a=1)],
    }
    torch.save(contents(several), tmp_path / "a")
    values = read_checkpoint(tmp_path / "a")["more"]
    assert values.keys() == several.keys()
    for name in ("tensors", "shared"):
        assert all(torch.equal(a, b) for a, b in zip(values[name], several[name], strict=True))
    assert torch.equal(values["parameter"], layer.weight)
    assert values["layer"]._metadata == several["layer"]._metadata
    assert [values[name] for name in ("bytes", "names", "counts")] == [
        several[name] for name in ("bytes", "names", "counts")
    ]
    assert values["shared"][1].untyped_storage().data_ptr() == values["shared"][0].untyped_storage().data_ptr()
