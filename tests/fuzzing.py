"""Files that are damaged at random, and how readers are held to their contract: return or refuse, within bounds."""

import copy
import faulthandler
import gzip
import io
import json
import os
import resource
import signal
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from completesplat.errors import CompleteSplatError

SECONDS = 60 * float(os.environ.get("FUZZ_MINUTES", 0))
"""For each reader; 0: the same few examples every time."""
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
MOST_MEMORY = 2**28
MOST_SECONDS = 10.0  # of computing
MOST_SECONDS_OF_A_HANG = 60  # of computing; the process is ended then
LIMIT = 2**32  # beyond what the process has, so that the machine survives what is found
ROUND = 400

NUMBERS = [0, 1, 2, 7, 8, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63]
NUMBERS += [2**64 - 1]


@contextmanager
def bounded(most_memory: int) -> Iterator[None]:
    """Fail if what is done takes more memory or time; end the process, with a traceback, if it does not come back.

    The file that it was reading then lies in pytest's temporary folder.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + LIMIT, hard))
    CLEAR.write_text("5")  # the largest so far, VmHWM, becomes what it is now
    before, start = _memory("VmRSS"), time.process_time()
    # A program that never comes back from C gets no exception: this prints where it is, and ends it.
    faulthandler.register(signal.SIGPROF, file=sys.__stderr__, chain=True)
    signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS_OF_A_HANG)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.unregister(signal.SIGPROF)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    taken, seconds = _memory("VmHWM") - before, time.process_time() - start
    assert taken < most_memory, f"took {taken / 2**20:.0f} MiB"
    assert seconds < MOST_SECONDS, f"took {seconds:.1f} s"


def _memory(entry: str) -> int:
    """Bytes of this process, by a name of `/proc/self/status`."""
    return int(STATUS.read_text().partition(f"{entry}:")[2].split()[0]) * 1024


def fuzz(
    inputs: st.SearchStrategy[Any],
    read: Callable[[Any], object],
    cases: Iterable[Any] = (),
    examples: int = 30,
    most_memory: int = MOST_MEMORY,
) -> None:
    """Have a reader read a few examples, or with `FUZZ_MINUTES` new ones for as long.

    Args:
        read: writes an input where it belongs and reads it; raises `CompleteSplatError` or nothing.
        cases: inputs that are read first.
    """

    def check(content: Any) -> None:
        with bounded(most_memory):
            try:
                read(content)
            except CompleteSplatError as error:
                str(error)

    check.__name__ = f"check_{read.__name__}"  # by which hypothesis keeps what it found
    for case in cases:
        check(case)
    given_files = given(inputs)(check)
    long = settings(max_examples=ROUND, derandomize=False, database=settings.get_profile("default").database)
    short = settings(max_examples=examples, derandomize=True, phases=[Phase.generate])
    run = settings(long if SECONDS else short, deadline=None, suppress_health_check=list(HealthCheck))(given_files)
    end = time.monotonic() + SECONDS
    while True:
        run()
        if time.monotonic() >= end:
            return


@st.composite
def damaged(draw: Any, seeds: Sequence[bytes], edits: int = 6) -> bytes:
    """Draw a file with up to `edits` edits: bytes and numbers changed; parts removed, repeated or swapped in."""
    content = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, edits))):
        place = draw(st.integers(0, len(content)))
        kind = draw(st.sampled_from(["byte", "number", "number", "cut", "remove", "repeat", "insert", "splice"]))
        if kind == "byte":
            content[place : place + 1] = bytes([draw(st.integers(0, 255))])
        elif kind == "number":
            order, size = draw(st.sampled_from("<>")), draw(st.sampled_from("BHIQ"))
            value = draw(st.sampled_from(NUMBERS) | st.integers(0, 2**64 - 1))
            packed = struct.pack(order + size, value % 2 ** (8 * struct.calcsize(size)))
            content[place : place + len(packed)] = packed
        elif kind == "cut":
            del content[place:]
        elif kind == "remove":
            del content[place : place + draw(st.integers(1, 64))]
        elif kind == "repeat":
            content[place:place] = content[place : place + draw(st.integers(1, 64))] * draw(st.integers(1, 20))
        elif kind == "insert":
            content[place:place] = draw(st.binary(min_size=1, max_size=16))
        else:
            other = draw(st.sampled_from(seeds))
            content[place:] = other[draw(st.integers(0, len(other))) :]
    return bytes(content)


DEEP = [[[]]]
for _ in range(40):
    DEEP = [DEEP, DEEP[:1]][:1]
ODD: list[Any] = [None, True, False, 0, -1, 1, 0.5, -0.0, 1e-320, 1e308, -1e308, 10**30, 2**63, -(2**63), 10**400]
ODD += [float("nan"), float("inf"), -float("inf"), "", "0", "x" * 5000, "\0", "..", "../x", "/", "\ud800", "\udcff"]
ODD += ["é\u202e\x1b[2J", "1e5", [], {}, [None], [[]], {"": {}}, DEEP, [0] * 1000, "C:\\x", "file:///x", "."]


@st.composite
def damaged_json(draw: Any, seeds: Sequence[Any], edits: int = 4) -> Any:
    """Draw a JSON value in which up to `edits` values are odd, from another place, missing or double."""
    content: Any = [copy.deepcopy(draw(st.sampled_from(seeds)))]  # in a list, so that all of it may be another
    scraps = st.sampled_from(ODD) | st.floats() | st.integers() | st.text(max_size=8)
    for _ in range(draw(st.integers(1, edits))):
        place = content
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            inner = place[key]
            if isinstance(inner, dict | list) and inner and draw(st.integers(0, 5)):
                place = inner
                continue
            kind = draw(st.sampled_from(["odd", "odd", "odd", "remove", "double", "other"]))
            if kind == "odd":
                place[key] = copy.deepcopy(draw(scraps))
            elif kind == "remove" and place is not content:
                del place[key]
            elif kind == "double" and isinstance(place, list):
                place.insert(key, copy.deepcopy(inner))
            elif kind == "double" and place is not content:
                place[draw(st.sampled_from(["x", "_target_", "", "path", *map(str, keys)]))] = copy.deepcopy(inner)
            else:
                place[key] = copy.deepcopy(place[draw(st.sampled_from(keys))])
            break
    return content[0]


def json_bytes(content: Any) -> bytes:
    """Return the content as Python's JSON, which may hold NaN."""
    return json.dumps(content).encode()


def gzipped(content: bytes) -> bytes:
    return gzip.compress(content, 1, mtime=0)


def png_parts(content: bytes) -> list[tuple[bytes, bytes]]:
    """Names and contents of a PNG's chunks, the pixels unpacked."""
    parts, place = [], 8
    while place < len(content):
        size, name = struct.unpack_from(">I4s", content, place)
        data = content[place + 8 : place + 8 + size]
        parts.append((name, zlib.decompress(data) if name == b"IDAT" else data))
        place += 12 + size
    return parts


def png_of(parts: Iterable[tuple[bytes, bytes]]) -> bytes:
    """A PNG with right checksums."""
    content = b"\x89PNG\r\n\x1a\n"
    for name, data in parts:
        data = zlib.compress(data, 1) if name == b"IDAT" else data
        content += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return content


def zip_parts(content: bytes) -> list[tuple[bytes, bytes]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [(name.encode(), archive.read(name)) for name in archive.namelist()]


def zip_of(parts: Iterable[tuple[bytes, bytes]]) -> bytes:
    """An archive with right checksums, nothing compressed."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in parts:
            archive.writestr(zipfile.ZipInfo(name.decode("latin-1").replace("\0", "_") or "_"), data)
    return file.getvalue()


@st.composite
def damaged_parts(
    draw: Any,
    seeds: Sequence[Sequence[tuple[bytes, bytes]]],
    whole: Callable[[Iterable[tuple[bytes, bytes]]], bytes],
    edits: int = 4,
) -> bytes:
    """A file of parts whose checksums are right: parts that are damaged, left out, double, of another file."""
    parts = list(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 3))):
        if not parts:
            break
        index = draw(st.integers(0, len(parts) - 1))
        name, data = parts[index]
        kind = draw(st.sampled_from(["damage", "damage", "damage", "remove", "double", "other", "name"]))
        if kind == "damage":
            parts[index] = name, draw(damaged([data], edits))
        elif kind == "remove":
            del parts[index]
        elif kind == "double":
            parts.insert(index, parts[index])
        elif kind == "other":
            parts.insert(index, draw(st.sampled_from(draw(st.sampled_from(seeds)))))
        else:
            parts[index] = draw(st.sampled_from([part for seed in seeds for part, _ in seed])), data
    return whole(parts)
