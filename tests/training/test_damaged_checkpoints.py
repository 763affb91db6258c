"""A checkpoint that is not as it was written is noticed, and the newest whole one is taken in its place."""

import random
import shutil
import struct
import zipfile

import pytest
import torch
from fuzzing import bounded
from support import SMALL, refused, strict_json

from completesplat.errors import WeightsError
from completesplat.training.checkpoints import CheckpointFiles
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.weights.checkpoint_reading import check_whole, load_part, read_checkpoint


@pytest.fixture
def checkpoint(tmp_path):
    torch.manual_seed(0)
    CheckpointFiles().save_checkpoint({"state_dict": torch.nn.Linear(30, 30).state_dict()}, tmp_path / "last.ckpt")
    return tmp_path / "last.ckpt"


def flip(path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def test_every_flipped_bit_and_every_cut_is_noticed(checkpoint):
    whole, chance = checkpoint.read_bytes(), random.Random(0)
    check_whole(checkpoint)
    for bit in [*chance.sample(range(8 * len(whole)), 300), *range(8 * len(whole) - 8 * 100, 8 * len(whole), 7)]:
        flip(checkpoint, bit)
        with pytest.raises(WeightsError, match=r"last\.ckpt: not a readable checkpoint"):
            check_whole(checkpoint)
        flip(checkpoint, bit)
    assert checkpoint.read_bytes() == whole
    for size in [*chance.sample(range(len(whole)), 100), *range(len(whole) - 100, len(whole), 2)]:
        checkpoint.write_bytes(whole[:size])
        with pytest.raises(WeightsError, match=r"last\.ckpt: not a readable checkpoint"):
            check_whole(checkpoint)


def test_a_damaged_checkpoint_is_refused_where_weights_are_loaded(checkpoint):
    load_part(torch.nn.Linear(30, 30), checkpoint, prefix="")
    weights = checkpoint.read_bytes().index(read_checkpoint(checkpoint)["state_dict"]["weight"].numpy().tobytes())
    flip(checkpoint, 8 * weights + 3)
    for load in (lambda: load_part(torch.nn.Linear(30, 30), checkpoint, ""), lambda: torch_io(checkpoint)):
        with pytest.raises(WeightsError, match=r"last\.ckpt: not a readable checkpoint \(damaged"):
            load()


def torch_io(path):
    """As Lightning loads a run that goes on."""
    return CheckpointFiles().load_checkpoint(path, weights_only=True)


def test_what_torch_saves_is_read_without_a_checksum(tmp_path):
    torch.save({"state_dict": {"a": torch.ones(2)}}, tmp_path / "own.ckpt")
    assert read_checkpoint(tmp_path / "own.ckpt")["state_dict"]["a"].tolist() == [1, 1]


def test_bytes_of_a_callback_are_read(tmp_path):
    torch.save({"state_dict": {"a": torch.ones(2)}, "callbacks": {"own": bytes(range(256))}}, tmp_path / "last.ckpt")
    assert read_checkpoint(tmp_path / "last.ckpt")["callbacks"]["own"] == bytes(range(256))


def test_a_checkpoint_that_is_larger_than_its_file_is_refused(tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save({"state_dict": {"a": torch.zeros(2**22)}}, path)
    with zipfile.ZipFile(path) as archive:
        records = {record: archive.read(record) for record in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for record, content in records.items():
            archive.writestr(record, content)
    with bounded(2**23), pytest.raises(WeightsError, match="its parts are larger than the file"):
        read_checkpoint(path)
    for contents in ({"a": torch.zeros(1).expand(2**28)}, {"a": [(torch.zeros(1).expand(2**40),)]}):
        torch.save({"state_dict": contents}, path)
        with bounded(2**26), pytest.raises(WeightsError, match="a tensor is larger than the file"):
            read_checkpoint(path)
    torch.save({"state_dict": {"a": torch.zeros(1).expand(2**10)}}, path)
    assert read_checkpoint(path)["state_dict"]["a"].shape == (2**10,)


def test_numbers_that_the_file_does_not_have_are_refused(tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save({"state_dict": {"a": torch.ones(2)}}, path)
    with zipfile.ZipFile(path) as archive:
        records = {record: archive.read(record) for record in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for record, content in records.items():
            archive.writestr(record, content.replace(b"K\x02", b"J" + struct.pack("<i", 2**28)))
    with bounded(2**26), pytest.raises(WeightsError, match="not a readable checkpoint"):
        read_checkpoint(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(pipeline, tmp_path, value):
    run = shutil.copytree(pipeline.var, tmp_path / "run")
    path = run / "checkpoints/last.ckpt"
    contents = torch.load(path, weights_only=True)
    name = next(name for name in contents["state_dict"] if name.endswith("bias"))
    contents["state_dict"][name][0] = value
    torch.save(contents, path)
    assert refused("test", f"ckpt={path}", "trainer.accelerator=cpu") == f"{path}: {name} is not finite"


def fit(command, root, run, *settings):
    given = ["experiment=toy_var", f"data.root={root}", *SMALL, "trainer.max_steps=5", "callbacks.pictures=null"]
    given += ["test=false", "callbacks.checkpoint.every_n_train_steps=1", "ckpt_path=last", f"out={run}"]
    return command("fit", *given, *settings)


def test_a_run_goes_on_from_the_newest_whole_checkpoint(command, toy_root, tmp_path, monkeypatch):
    step, run = ReconstructionModule.training_step, tmp_path / "run"
    last, previous, milestone = (run / f"checkpoints/{name}.ckpt" for name in ("last", "previous", "step=2"))

    def interrupted_step(self, *inputs):
        if self.global_step == 4:
            raise KeyboardInterrupt
        return step(self, *inputs)

    with monkeypatch.context() as patch:
        patch.setattr(ReconstructionModule, "training_step", interrupted_step)
        assert fit(command, toy_root, run, "callbacks.checkpoint.keep_every=2").status == 1
    whole = {path: path.read_bytes() for path in (run / "checkpoints").iterdir()}
    assert whole.keys() == {last, previous, milestone, run / "checkpoints/step=4.ckpt"}

    for path in whole:
        path.write_bytes(b"nothing")
    finished = fit(command, toy_root, run, "callbacks.checkpoint.keep_every=2")
    assert finished.status == 2
    assert finished.err.splitlines()[-1].startswith(f"error: {last}: not a readable checkpoint")

    for path, content in whole.items():
        path.write_bytes(content)
    last.write_bytes(whole[last][:-1000])
    assert [read_checkpoint(path)["global_step"] for path in (previous, milestone)] == [3, 2]

    finished = fit(command, toy_root, run, "callbacks.checkpoint.keep_every=2")
    assert finished.status == 0, finished.err
    assert (run / "commands.log").read_text().count("not a readable checkpoint") == 1
    warning = f"{last}: not a readable checkpoint (damaged at its end, or cut off); going on from {previous}"
    assert warning in (run / "commands.log").read_text().splitlines()
    assert strict_json(run / "metrics.json")["steps"] == 5
    assert read_checkpoint(last)["global_step"] == 5
    assert not previous.exists()
