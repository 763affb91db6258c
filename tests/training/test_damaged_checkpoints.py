"""A checkpoint that is not as it was written is noticed, and the newest whole one is taken in its place."""

import random
import shutil
import struct
import zipfile
import zlib
from contextlib import suppress
from functools import partial

import pytest
import torch
from small_runs import STEPS, Logging, fit
from support import flip_bit, refused

from completesplat.errors import WeightsError
from completesplat.training.checkpoints import CheckpointFiles, newest_whole
from completesplat.weights.checkpoint_reading import check_whole, load_part, read_checkpoint


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    CheckpointFiles().save_checkpoint({"state_dict": torch.nn.Linear(30, 30).state_dict()}, tmp_path / "last.ckpt")
    return tmp_path / "last.ckpt"


def refusal(path) -> str | None:
    try:
        check_whole(path)
    except WeightsError as error:
        return str(error)
    return None


def test_every_flipped_bit_and_every_cut_is_noticed_unless_it_changes_nothing(checkpoint):
    whole, chance, bits_of_a_value = checkpoint.read_bytes(), random.Random(0), 8 * 30 * 30 * 4
    weights = read_checkpoint(checkpoint)["state_dict"]
    first = 8 * whole.index(weights["weight"].numpy().tobytes())
    check_whole(checkpoint)
    noticed = set()
    for bit in [*chance.sample(range(8 * len(whole)), 60), *range(8 * len(whole) - 8 * 100, 8 * len(whole), 17)]:
        flip_bit(checkpoint, bit)
        message = refusal(checkpoint)
        if message is not None:
            assert message.startswith(f"{checkpoint}: not a readable checkpoint (damaged")
            noticed.add(bit)
        else:
            read = read_checkpoint(checkpoint)["state_dict"]
            assert all(torch.equal(weights[name], value) for name, value in read.items())
            assert read.keys() == weights.keys()
        flip_bit(checkpoint, bit)
    assert any(first <= bit < first + bits_of_a_value for bit in noticed)
    assert checkpoint.read_bytes() == whole
    for size in [*chance.sample(range(len(whole)), 30), *range(len(whole) - 100, len(whole), 5)]:
        checkpoint.write_bytes(whole[:size])
        with pytest.raises(WeightsError, match=r"last\.ckpt: not a readable checkpoint"):
            check_whole(checkpoint)


def two_lists(path, order: int) -> None:
    """Give a checkpoint a second list of its parts, with the same places, in this order; zipfile reads it, torch not.

    The end of an archive says where the list begins, and how long it is. torch goes by the one, zipfile by the other.
    The parts begin at 65,536, because what zipfile reads as a place is larger than what stands there.
    """
    with zipfile.ZipFile(path) as records:
        parts = [(record.filename, records.read(record)) for record in records.infolist()]
    body, first, second = bytearray(b"PK\3\4".ljust(1 << 16, b"\0")), bytearray(), []
    for name, content in parts:
        sizes = struct.pack("<LLLHH", zlib.crc32(content), len(content), len(content), len(name), 0)
        row = b"PK\1\2" + struct.pack("<6H", 20, 20, 0, 0, 0, 33) + sizes + struct.pack("<HHHL", 0, 0, 0, 0)
        first += row + struct.pack("<L", len(body)) + name.encode()
        second.append((row, len(body), name.encode()))
        body += b"PK\3\4" + struct.pack("<5H", 20, 0, 0, 0, 33) + sizes + name.encode() + content
    rows = [row + struct.pack("<L", place - len(first)) + name for row, place, name in second[::order]]
    end = b"PK\5\6" + struct.pack("<4HLLH", 0, 0, len(parts), len(parts), len(first), len(body), 0)
    path.write_bytes(body + first + b"".join(rows) + end)


@pytest.mark.parametrize("order", [1, -1])
def test_a_file_with_two_lists_of_its_parts_is_refused(checkpoint, order):
    """Sizes in the list that is not checked could be any."""
    two_lists(checkpoint, order)
    with zipfile.ZipFile(checkpoint) as records:
        assert records.testzip() is None
    assert torch.load(checkpoint, weights_only=True)["state_dict"].keys() == {"weight", "bias"}
    assert "two lists of its parts" in refusal(checkpoint)


def test_a_damaged_checkpoint_is_refused_where_weights_are_loaded(checkpoint):
    load_part(torch.nn.Linear(30, 30), checkpoint, prefix="")
    weights = checkpoint.read_bytes().index(read_checkpoint(checkpoint)["state_dict"]["weight"].numpy().tobytes())
    flip_bit(checkpoint, 8 * weights + 3)
    resume = partial(CheckpointFiles().load_checkpoint, weights_only=True)  # as Lightning does
    for load in (lambda: load_part(torch.nn.Linear(30, 30), checkpoint, ""), lambda: resume(checkpoint)):
        with pytest.raises(WeightsError, match=r"last\.ckpt: not a readable checkpoint \(damaged"):
            load()


def test_weights_that_are_not_finite_are_refused(pipeline, tmp_path):
    run = shutil.copytree(pipeline.var, tmp_path / "run")
    path = run / "checkpoints/last.ckpt"
    contents = torch.load(path, weights_only=True)
    name = next(name for name in contents["state_dict"] if name.endswith("bias"))
    contents["state_dict"][name][0] = float("nan")
    torch.save(contents, path)
    assert refused("test", f"ckpt={path}", "trainer.accelerator=cpu") == f"{path}: {name} is not finite"


class Interrupted(Logging):
    def training_step(self, batch, index):
        if self.global_step == 4:
            raise KeyboardInterrupt
        return super().training_step(batch, index)


def test_a_run_goes_on_from_the_newest_whole_checkpoint(tmp_path, caplog):
    caplog.set_level("WARNING")
    last, previous, milestone = (tmp_path / f"checkpoints/{name}.ckpt" for name in ("last", "previous", "step=2"))
    with suppress(SystemExit, KeyboardInterrupt):
        fit(tmp_path, model=Interrupted, keep_every=2)
    whole = {path: path.read_bytes() for path in (tmp_path / "checkpoints").iterdir()}
    assert whole.keys() == {last, previous, milestone, tmp_path / "checkpoints/step=4.ckpt"}
    assert [read_checkpoint(path)["global_step"] for path in (last, previous, milestone)] == [4, 3, 2]
    assert newest_whole(last) == last
    assert not caplog.records

    for path in whole:
        path.write_bytes(b"nothing")
    with pytest.raises(WeightsError, match=rf"{last}: not a readable checkpoint"):
        newest_whole(last)
    milestone.write_bytes(whole[milestone])
    assert newest_whole(last) == milestone
    previous.write_bytes(whole[previous])
    last.write_bytes(whole[last][:-1000])
    caplog.clear()
    assert newest_whole(last) == previous
    reason = "damaged, cut off or of another format: BadZipFile"
    warning = f"{last}: not a readable checkpoint ({reason}); going on from {previous}"
    assert [record.getMessage() for record in caplog.records] == [warning]
    fit(tmp_path, start=previous)
    assert read_checkpoint(last)["global_step"] == STEPS
    assert not previous.exists()
    last.unlink()
    caplog.clear()
    assert newest_whole(last) == tmp_path / "checkpoints/step=15.ckpt"
    assert [record.getMessage().partition(";")[0] for record in caplog.records] == [f"{last}: is not there"]
    assert newest_whole(tmp_path / "last.ckpt") is None
