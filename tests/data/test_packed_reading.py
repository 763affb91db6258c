import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from packed_sequences import SIZE, ListedSource, make_sequence, pack, smooth_image
from PIL import Image
from readers import put
from support import flip_bit, python

from completesplat.data.packed.manifest import is_packed, read_manifest, settings_must_match
from completesplat.data.packed.rows import EncodedImage, decode_square, encode, from_row, to_row
from completesplat.data.packed.source import PackedSource
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.errors import (
    BadAnnotation,
    BadImage,
    ChangedFile,
    DataError,
    MissingFile,
    OutsidePath,
    UnreadableFile,
)

NAMES = ["s3", "s1", "s4", "s0", "s5", "s9", "s2"]
SHARD = "train-00000-of-00003.arrow"


def make(out: Path, masked: bool = True, **options: Any) -> Path:
    return pack(ListedSource(NAMES, masked=masked), out, sequences_per_shard=3, **options)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return make(tmp_path / "store")


def assert_same(sequence: PosedSequence, expected: PosedSequence, tolerance: int = 0) -> None:
    assert (sequence.name, sequence.frames) == (expected.name, expected.frames)
    assert sequence.cameras.image_size == expected.cameras.image_size
    for part in ("world_to_camera", "intrinsics"):
        one, other = getattr(sequence.cameras, part), getattr(expected.cameras, part)
        assert one.dtype == other.dtype == torch.float64
        assert one.numpy().tobytes() == other.numpy().tobytes()
    assert torch.equal(sequence.depth_ranges, expected.depth_ranges)
    for index in range(len(sequence.frames)):
        (image, mask), (expected_image, expected_mask) = sequence.read(index), expected.read(index)
        assert (image.int() - expected_image.int()).abs().max() <= tolerance
        assert (mask is None) == (expected_mask is None)
        assert mask is None or torch.equal(mask, expected_mask)


@pytest.mark.parametrize(("codec", "masked"), [("png", True), ("bmp", False)])
def test_png_and_bmp_give_back_every_bit_also_in_other_processes(masked: bool, codec: str, tmp_path: Path) -> None:
    source = PackedSource(make(tmp_path / "store", masked, codec=codec), "train")
    assert isinstance(source, SequenceSource)
    assert source.names == NAMES
    assert (source.refused, source.left_out, source.fingerprint()) == ([], {}, "a")
    for name in NAMES:
        assert_same(source.read(name), make_sequence(name, masked=masked))
    assert_same(pickle.loads(pickle.dumps(source)).read("s0"), make_sequence("s0", masked=masked))


def test_jpeg_keeps_cameras_and_masks_and_changes_colours_by_little(tmp_path: Path) -> None:
    source = PackedSource(make(tmp_path / "store", codec="jpeg"), "train")
    expected, sequence = make_sequence("s3"), source.read("s3")
    assert_same(sequence, expected, tolerance=16)
    differences = [sequence.read(index).image.float() - expected.read(index).image for index in range(4)]
    assert 0 < torch.stack(differences).abs().mean() < 2


def test_one_store_serves_smaller_images_as_pillow_makes_them(tmp_path: Path) -> None:
    store, size = make(tmp_path / "store", masked=True), SIZE // 2
    large, small = (PackedSource(store, "train", image_size).read("s1") for image_size in (None, size))
    assert torch.equal(small.cameras.world_to_camera, large.cameras.world_to_camera)
    torch.testing.assert_close(small.cameras.intrinsics[:, :2] * 2, large.cameras.intrinsics[:, :2])
    assert small.cameras.image_size == (size, size)
    for index in range(4):
        for part, whole, filtered in zip(small.read(index), large.read(index), ("LANCZOS", "BILINEAR"), strict=True):
            image = Image.fromarray(whole.numpy().transpose(1, 2, 0).squeeze())
            expected = np.asarray(image.resize((size, size), Image.Resampling[filtered])).reshape(size, size, -1)
            assert np.array_equal(part.numpy(), expected.transpose(2, 0, 1))


def test_masks_of_some_frames_only_stay_with_them() -> None:
    image, mask = smooth_image(1, True)
    images = [EncodedImage(encode(image, "png"), content) for content in (None, encode(mask, "png"))]
    read = from_row(to_row(make_sequence("s", (10, 13)), [0, 1], images), "file", "s").read
    assert read(0).mask is None
    assert torch.equal(read(1).mask, mask)


def test_names_keep_the_order_of_the_source_though_chunks_lie_together(tmp_path: Path) -> None:
    class Interleaved(ListedSource):
        def groups(self, names: Any) -> list[list[int]]:
            return [list(range(0, len(names), 2)), list(range(1, len(names), 2))]

    pack(Interleaved(NAMES), tmp_path / "store", "val", sequences_per_shard=4)
    source = PackedSource(tmp_path / "store", "val")
    assert [shard.sequences for shard in source.shards] == [tuple(NAMES[::2]), tuple(NAMES[1::2])]
    assert source.names == NAMES
    for name in NAMES:
        assert_same(source.read(name), make_sequence(name))


def test_only_a_complete_store_with_its_own_shards_opens(store: Path, tmp_path: Path) -> None:
    source = PackedSource(store, "train")
    assert is_packed(store)
    assert source.verify() == []
    with pytest.raises(DataError, match=r"no split test .* there are: train"):
        PackedSource(store, "test")
    assert not is_packed(tmp_path)
    with pytest.raises(MissingFile):
        read_manifest(tmp_path)
    shard = store / SHARD
    content = shard.read_bytes()
    flip_bit(shard, -99 * 8)
    assert [error.file for error in source.verify()] == [str(shard)]
    shard.write_bytes(content + b"\0")
    with pytest.raises(ChangedFile, match=SHARD):
        PackedSource(store, "train")
    shard.unlink()
    with pytest.raises(MissingFile, match=SHARD):
        PackedSource(store, "train")
    shard.symlink_to(store.parent / "elsewhere")
    with pytest.raises(OutsidePath):
        PackedSource(store, "train")


def test_wherever_a_byte_of_a_shard_changes_its_sequences_are_refused_or_the_same(store: Path) -> None:
    content = (store / SHARD).read_bytes()
    places, intact = set(), 0
    for position in np.random.default_rng(0).choice(len(content), 16, replace=False):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        # Never in place: pages of an earlier round may still be mapped.
        (store / "damaged").write_bytes(damaged)
        (store / "damaged").replace(store / SHARD)
        for name in NAMES[:3]:
            try:
                assert_same(PackedSource(store, "train").read(name), make_sequence(name))
                intact += 1
            except DataError as error:
                places.add((error.file, error.sequence))
    assert places == {(str(store / SHARD), name) for name in NAMES[:3]}
    assert intact


def other_columns(store: Path) -> bytes:
    table, stream = pa.table({"name": ["s3", "s1", "s4"]}), pa.BufferOutputStream()
    with pa.ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)
    return stream.getvalue().to_pybytes()


@pytest.mark.parametrize(
    ("content", "kind", "reason"),
    [
        (lambda store: b"\xff\xff\xff\xff\x10\0\0\0" + b"\7" * 90, UnreadableFile, SHARD),
        (other_columns, UnreadableFile, "columns"),
        (lambda store: (store / "train-00001-of-00003.arrow").read_bytes(), BadAnnotation, "in its place"),
        (lambda store: (store / "train-00002-of-00003.arrow").read_bytes(), BadAnnotation, "1 sequences, the manifest"),
    ],
)
def test_a_shard_that_is_another_file_is_refused_when_it_is_read(content, kind, reason, store: Path) -> None:
    source = PackedSource(store, "train")
    (store / SHARD).write_bytes(content(store))
    with pytest.raises(kind, match=reason) as caught:
        source.read("s3")
    assert caught.value.sequence == "s3"


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
        ("images", [b""], BadAnnotation),
        ("size", None, ChangedFile),
        ("name", "other", BadAnnotation),
    ],
)
def test_a_row_that_does_not_fit_is_refused_with_its_place(column: str, value: object, kind: type[DataError]) -> None:
    row = to_row(make_sequence("s", (10, 13)), [0, 1], [EncodedImage(b"", b"")] * 2)
    with pytest.raises(kind) as caught:
        from_row(change(row, column, value), "shard.arrow", "s")
    assert (caught.value.file, caught.value.sequence) == ("shard.arrow", "s")


def test_bytes_that_are_not_the_image_are_refused_with_their_place() -> None:
    image = encode(smooth_image(0, True).image, "jpeg")
    # Where the checksum is that of the wrong bytes, decoding them has to notice.
    for wrong in (image[: len(image) // 2], encode(smooth_image(0, True, size=SIZE + 1).image, "png")):
        images = [EncodedImage(image, None), EncodedImage(wrong, None)]
        sequence = from_row(to_row(make_sequence("s", (10, 13)), [0, 1], images), "shard.arrow", "s")
        sequence.read(0)
        with pytest.raises(BadImage) as caught:
            sequence.read(1)
        assert (caught.value.file, caught.value.sequence, caught.value.frame) == ("shard.arrow", "s", 13)
    flipped = image[:-20] + bytes([image[-20] ^ 1]) + image[-19:]
    assert decode_square(flipped, 3, SIZE, SIZE).shape == (3, SIZE, SIZE)
    row = to_row(make_sequence("s", (10, 13)), [0, 1], [EncodedImage(image, None)] * 2)
    read = from_row(change(row, "images", [image, flipped]), "shard.arrow", "s").read
    read(0)
    with pytest.raises(BadImage, match="no longer"):
        read(1)


@pytest.mark.parametrize(
    ("keys", "value", "kind"),
    [
        ("format", 1, UnreadableFile),
        ("settings", {"image_size": [1]}, BadAnnotation),
        ("splits.train.names", ["s3"], BadAnnotation),
        ("splits.train.refused", [{}], BadAnnotation),
        ("splits.train.shards.0.file", "../secret.arrow", OutsidePath),
        ("splits.train.shards.0.bytes", True, BadAnnotation),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(keys: str, value: object, kind: type, store: Path) -> None:
    put("manifest.json", keys, value)(store)
    with pytest.raises(kind, match=r"manifest\.json"):
        PackedSource(store, "train")


def test_other_settings_than_those_baked_in_are_refused_by_name(store: Path) -> None:
    settings_must_match(store, {"image_size": float(SIZE)})
    settings_must_match(store, {"image_size": SIZE // 2})  # images are made smaller when they are read
    with pytest.raises(DataError, match=r"crop=None \(asked for: central\), image_size=16 \(asked for: 32\)"):
        settings_must_match(store, {"image_size": 32, "crop": "central"})


@pytest.mark.processes
def test_reading_needs_no_network_and_writes_nothing_into_the_home_folder(store: Path, tmp_path: Path) -> None:
    lines = [
        "import socket; socket.socket.connect = None",
        "from pathlib import Path",
        "from completesplat.data.packed.source import PackedSource",
        f"print(*PackedSource(Path({str(store)!r}), 'train').read('s0').read(0).image.shape)",
    ]
    (home := tmp_path / "home").mkdir()
    variables = ("HF_HOME", "HF_DATASETS_CACHE", "XDG_CACHE_HOME")
    environment = {key: value for key, value in os.environ.items() if key not in variables} | {"HOME": str(home)}
    assert python("\n".join(lines), env=environment).split() == ["3", str(SIZE), str(SIZE)]
    assert list(home.rglob("*")) == []
