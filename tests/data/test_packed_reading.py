import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from packed_sequences import SIZE, ListedSource, make_sequence, smooth_picture

from completesplat.data.packed.manifest import is_packed, read_manifest, settings_must_match
from completesplat.data.packed.rows import EncodedPicture, decode, encode, from_row, to_row
from completesplat.data.packed.source import PackedSource
from completesplat.data.packed.writing import prepare
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.validation import (
    BadAnnotation,
    BadPicture,
    ChangedFile,
    MissingFile,
    OutsidePath,
    UnreadableFile,
)
from completesplat.errors import DataError

NAMES = ["s3", "s1", "s4", "s0", "s5", "s9", "s2"]
SHARD = "train-00000-of-00003.arrow"


def make(out: Path, masked: bool = True, **options: Any) -> Path:
    source = ListedSource(NAMES, masked=masked)
    return prepare(
        {"train": source}, {"image_size": SIZE}, out, sequences_per_shard=3, workers=1, progress=False, **options
    )


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return make(tmp_path / "store")


def assert_same(found: PosedSequence, expected: PosedSequence, tolerance: int = 0) -> None:
    assert (found.name, found.frames, found.cameras.image_size) == (
        expected.name,
        expected.frames,
        expected.cameras.image_size,
    )
    for part in ("world_to_camera", "intrinsics"):
        one, other = getattr(found.cameras, part), getattr(expected.cameras, part)
        assert one.dtype == other.dtype == torch.float64
        assert one.numpy().tobytes() == other.numpy().tobytes()
    assert torch.equal(found.depth_ranges, expected.depth_ranges)
    for index in range(len(found.frames)):
        (image, mask), (expected_image, expected_mask) = found.read(index), expected.read(index)
        assert (image.int() - expected_image.int()).abs().max() <= tolerance
        assert (mask is None) == (expected_mask is None)
        assert mask is None or torch.equal(mask, expected_mask)


@pytest.mark.parametrize("codec", ["png", "bmp"])
@pytest.mark.parametrize("masked", [True, False])
def test_png_and_bmp_give_back_every_bit(masked: bool, codec: str, tmp_path: Path) -> None:
    source: SequenceSource = PackedSource(make(tmp_path / "store", masked, codec=codec), "train")
    assert isinstance(source, SequenceSource)
    assert source.names == NAMES
    assert (source.refused, source.left_out, source.fingerprint()) == ([], {}, "a")
    for name in NAMES:
        assert_same(source.read(name), make_sequence(name, masked=masked))


def test_jpeg_keeps_cameras_and_masks_and_changes_colours_by_little(tmp_path: Path) -> None:
    source = PackedSource(make(tmp_path / "store", codec="jpeg"), "train")
    for name in NAMES:
        expected = make_sequence(name)
        assert_same(source.read(name), expected, tolerance=16)
        differences = [source.read(name).read(index).image.float() - expected.read(index).image for index in range(4)]
        assert 0 < torch.stack(differences).abs().mean() < 2


def test_masks_of_some_frames_only_stay_with_them() -> None:
    sequence = make_sequence("s", frames=2)
    pictures = [EncodedPicture(encode(smooth_picture(0, False).image, "png"), None)] * 2
    mask = smooth_picture(1, True).mask
    assert mask is not None
    pictures[1] = EncodedPicture(pictures[1].image, encode(mask, "png"))
    read = from_row(to_row(sequence, [0, 1], pictures), "file", "s").read
    assert read(0).mask is None
    assert torch.equal(read(1).mask, mask)  # type: ignore[arg-type]


def test_names_keep_the_order_of_the_source_though_chunks_lie_together(tmp_path: Path) -> None:
    class Interleaved(ListedSource):
        def groups(self, names: Any) -> list[list[int]]:
            return [list(range(0, len(names), 2)), list(range(1, len(names), 2))]

    prepare({"val": Interleaved(NAMES)}, {}, tmp_path / "store", sequences_per_shard=4, workers=1, progress=False)
    source = PackedSource(tmp_path / "store", "val")
    assert [shard.sequences for shard in source.shards] == [tuple(NAMES[::2]), tuple(NAMES[1::2])]
    assert source.names == NAMES
    for name in NAMES:
        assert_same(source.read(name), make_sequence(name))


def test_a_source_travels_to_other_processes_without_the_files_it_has_open(store: Path) -> None:
    source = PackedSource(store, "train")
    source.read("s0")
    small = pickle.dumps(source)
    assert b"datasets" not in small
    assert_same(pickle.loads(small).read("s0"), make_sequence("s0"))


def test_a_split_that_is_not_there_is_named_with_those_that_are(store: Path) -> None:
    with pytest.raises(DataError, match=r"no split test .* there are: train"):
        PackedSource(store, "test")


def test_only_a_complete_store_is_one(store: Path, tmp_path: Path) -> None:
    assert is_packed(store)
    assert not is_packed(tmp_path)
    with pytest.raises(MissingFile):
        read_manifest(tmp_path)


def test_opening_notices_shards_that_are_missing_or_of_another_size(store: Path) -> None:
    content = (store / SHARD).read_bytes()
    (store / SHARD).write_bytes(content + b"\0")
    with pytest.raises(ChangedFile, match=SHARD):
        PackedSource(store, "train")
    (store / SHARD).unlink()
    with pytest.raises(MissingFile, match=SHARD):
        PackedSource(store, "train")


def test_verifying_finds_the_shard_with_a_changed_bit(store: Path) -> None:
    source = PackedSource(store, "train")
    assert source.verify() == []
    content = bytearray((store / SHARD).read_bytes())
    content[len(content) // 2] ^= 1
    (store / SHARD).write_bytes(content)
    assert [error.file for error in source.verify()] == [str(store / SHARD)]


def refused_or_same(source: PackedSource, name: str) -> DataError | None:
    """The refusal, if there is one; fails on anything but the same sequence."""
    try:
        assert_same(source.read(name), make_sequence(name))
    except DataError as error:
        return error
    return None


def test_wherever_a_byte_of_a_shard_changes_its_sequences_are_refused_or_the_same(store: Path) -> None:
    content = (store / SHARD).read_bytes()
    refusals: list[DataError | None] = []
    for position in np.random.default_rng(0).choice(len(content), 30, replace=False):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        # Never in place: pages of an earlier round may still be mapped.
        (store / "damaged").write_bytes(damaged)
        (store / "damaged").replace(store / SHARD)
        refusals += [refused_or_same(PackedSource(store, "train"), name) for name in NAMES[:3]]
    places = {(error.file, error.sequence) for error in refusals if error}
    assert places == {(str(store / SHARD), name) for name in NAMES[:3]}
    assert None in refusals


@pytest.mark.parametrize("content", [b"", b"no arrow file", b"\xff\xff\xff\xff\x10\0\0\0" + b"\7" * 90])
def test_a_file_that_is_no_arrow_file_is_refused(content: bytes, store: Path) -> None:
    source = PackedSource(store, "train")
    (store / SHARD).write_bytes(content)
    with pytest.raises(UnreadableFile, match=SHARD) as caught:
        source.read("s3")
    assert caught.value.sequence == "s3"


def test_a_shard_with_other_columns_is_refused(store: Path) -> None:
    source = PackedSource(store, "train")
    table = pa.table({"name": ["s3", "s1", "s4"]})
    with pa.ipc.new_stream(str(store / SHARD), table.schema) as writer:
        writer.write_table(table)
    with pytest.raises(UnreadableFile, match="columns"):
        source.read("s3")


def test_a_shard_in_the_place_of_another_is_refused(store: Path) -> None:
    source = PackedSource(store, "train")
    full, last = [(store / shard.file).read_bytes() for shard in source.shards[1:]]
    for content, reason in [(full, "in its place"), (last, "1 sequences, the manifest says 3")]:
        (store / SHARD).unlink()
        (store / SHARD).write_bytes(content)
        with pytest.raises(BadAnnotation, match=reason):
            pickle.loads(pickle.dumps(source)).read("s3")


def change(row: pa.Table, column: str, value: object) -> pa.Table:
    content = row.to_pydict()
    content[column] = [value]
    return pa.Table.from_pydict(content, schema=row.schema)


@pytest.mark.parametrize(
    ("column", "value", "kind"),
    [
        ("world_to_camera", [1.0] * 31, BadAnnotation),
        ("world_to_camera", [float("nan")] * 32, BadAnnotation),
        ("world_to_camera", [1.0] * 32, ChangedFile),
        ("world_to_camera", None, BadAnnotation),
        ("intrinsics", [1.0] * 9, BadAnnotation),
        ("intrinsics", [float("inf")] * 18, BadAnnotation),
        ("intrinsics", [None] * 18, BadAnnotation),
        ("depth_ranges", [1.0, 2.0, 3.0], BadAnnotation),
        ("frames", [], BadAnnotation),
        ("frames", [10, 14], ChangedFile),
        ("images", [b""], BadAnnotation),
        ("masks", [], BadAnnotation),
        ("masks", None, BadAnnotation),
        ("picture_checksums", [1], BadAnnotation),
        ("size", 0, ChangedFile),
        ("size", None, ChangedFile),
        ("size", 17, ChangedFile),
        ("name", "other", BadAnnotation),
        ("name", None, BadAnnotation),
    ],
)
def test_a_row_that_does_not_fit_is_refused_with_its_place(column: str, value: object, kind: type[DataError]) -> None:
    row = to_row(make_sequence("s", frames=2), [0, 1], [EncodedPicture(b"", b"")] * 2)
    with pytest.raises(kind) as caught:
        from_row(change(row, column, value), "shard.arrow", "s")
    assert (caught.value.file, caught.value.sequence) == ("shard.arrow", "s")


@pytest.mark.parametrize(
    "change_image",
    [
        lambda image: b"",
        lambda image: image[: len(image) // 2],
        lambda image: encode(smooth_picture(0, True, size=SIZE + 1).image, "png"),
        lambda image: encode(smooth_picture(0, True).mask, "png"),  # type: ignore[arg-type]
        lambda image: b"GIF89a" + image,
    ],
)
def test_bytes_that_are_not_the_picture_are_refused_with_their_place(change_image: Callable[[bytes], bytes]) -> None:
    image = encode(smooth_picture(0, True).image, "png")
    # The checksum is that of the wrong bytes, so that decoding them has to notice.
    pictures = [EncodedPicture(image, None), EncodedPicture(change_image(image), None)]
    sequence = from_row(to_row(make_sequence("s", frames=2), [0, 1], pictures), "shard.arrow", "s")
    sequence.read(0)
    with pytest.raises(BadPicture) as caught:
        sequence.read(1)
    assert (caught.value.file, caught.value.sequence, caught.value.frame) == ("shard.arrow", "s", 13)


def test_pixels_that_decode_differently_from_what_was_written_are_refused() -> None:
    picture = EncodedPicture(encode(smooth_picture(0, True).image, "jpeg"), None)
    row = to_row(make_sequence("s", frames=2), [0, 1], [picture] * 2)
    flipped = bytearray(picture.image)
    flipped[-20] ^= 1
    assert decode(bytes(flipped), 3, SIZE).shape == (3, SIZE, SIZE)
    read = from_row(change(row, "images", [picture.image, bytes(flipped)]), "shard.arrow", "s").read
    read(0)
    with pytest.raises(BadPicture, match="no longer"):
        read(1)


def set_at(path: list[Any], value: object) -> Callable[[dict], None]:
    def edit(content: dict) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return edit


FIRST = ["splits", "train", "shards", 0]


@pytest.mark.parametrize(
    ("edit", "kind"),
    [
        (set_at(["format"], 1), UnreadableFile),
        (set_at(["format"], "1"), BadAnnotation),
        (set_at(["codec"], None), BadAnnotation),
        (set_at(["settings"], []), BadAnnotation),
        (set_at(["settings"], {"image_size": [1]}), BadAnnotation),
        (set_at(["splits"], []), BadAnnotation),
        (set_at(["splits", "train"], []), BadAnnotation),
        (set_at(["splits", "train", "names"], ["s3"]), BadAnnotation),
        (set_at(["splits", "train", "names", 0], 3), BadAnnotation),
        (set_at(["splits", "train", "listed"], None), BadAnnotation),
        (set_at(["splits", "train", "left_out"], {"x": "1"}), BadAnnotation),
        (set_at(["splits", "train", "refused"], [{}]), BadAnnotation),
        (set_at([*FIRST, "file"], "../secret.arrow"), OutsidePath),
        (set_at([*FIRST, "file"], "/etc/passwd"), OutsidePath),
        (set_at([*FIRST, "bytes"], -1.5), BadAnnotation),
        (set_at([*FIRST, "sequences"], "s3"), BadAnnotation),
        (lambda content: content.pop("splits"), BadAnnotation),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(
    edit: Callable[[dict], None], kind: type[DataError], store: Path
) -> None:
    content = json.loads((store / "manifest.json").read_text())
    edit(content)
    (store / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(kind, match=r"manifest\.json"):
        PackedSource(store, "train")


def test_a_shard_that_is_a_link_out_of_the_folder_is_refused(store: Path, tmp_path: Path) -> None:
    (store / SHARD).rename(tmp_path / "elsewhere")
    (store / SHARD).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutsidePath):
        PackedSource(store, "train")


def test_other_settings_than_those_baked_in_are_refused_by_name(store: Path) -> None:
    settings_must_match(store, {"image_size": SIZE})
    with pytest.raises(DataError, match=r"image_size=16 \(asked for: 32\)"):
        settings_must_match(store, {"image_size": 32})
    with pytest.raises(DataError, match=r"crop=None \(asked for: central\)"):
        settings_must_match(store, {"image_size": SIZE, "crop": "central"})


def test_reading_needs_no_network_and_writes_nothing_into_the_home_folder(store: Path, tmp_path: Path) -> None:
    code = (
        "import socket; socket.socket.connect = None\n"
        "from pathlib import Path\n"
        "from completesplat.data.packed.source import PackedSource\n"
        f"root = Path({str(store)!r})\n"
        "print(*PackedSource(root, 'train').read('s0').read(0).image.shape)\n"
    )
    home = tmp_path / "home"
    home.mkdir()
    environment = {**os.environ, "HOME": str(home), "HF_HUB_OFFLINE": "1"}
    for variable in ("HF_HOME", "HF_DATASETS_CACHE", "XDG_CACHE_HOME"):
        environment.pop(variable, None)
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["3", str(SIZE), str(SIZE)]
    assert list(home.rglob("*")) == []
