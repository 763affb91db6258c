"""FSDP: two processes, each with its share of the networks, train what one does, and read each other's checkpoints."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from safetensors.torch import load_file, save_file
from support import LIMIT, SMALL, compose_config, script, strict_json

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.training.checkpoints import CheckpointFiles, newest_whole
from completesplat.training.sharding import _refuse_undivided, remove_unused_shards
from completesplat.weights import sha256_of
from completesplat.weights.checkpoint_reading import DIVIDED, SHARDS, check_whole, read_checkpoint

LAST = "checkpoints/last.ckpt"
TORCHRUN = ["-m", "torch.distributed.run", "--nproc_per_node=2", "--standalone", "-m", "completesplat"]
FSDP = ["trainer=fsdp", "trainer.devices=2"]
# Without anything that is drawn in the steps, as what processes draw is their own.
STAGE1 = ["experiment=toy_var", "ablation=no_variational", "autoreconstructor.skip_dropout=0", *SMALL]
STAGE1 += ["data.image_size=16", "data.batch_size=4", "data.references_per_sequence=8", "optimizer.lr=0.1"]
STAGE1 += [
    "optimizer=adam",
    "optimizer._target_=torch.optim.SGD",
    "optimizer.fused=false",
    "trainer.precision=32-true",
    "trainer.val_check_interval=1",
]
STAGE2 = ["experiment=toy_diffusion", *SMALL, "trainer.precision=32-true", "data.references_per_sequence=8"]
STAGE2 += ["sampler.steps=2", "callbacks.samples.samples=1"]


def fit(launcher: list[str], root: Path, out: Path, *settings: object) -> Path:
    """Train as a shell would start it; the checkpoint."""
    given = [f"data.root={root}", "data.workers=0", "rasterizer=reference", *map(str, settings), f"out={out}"]
    program = launcher or [str(script(out.parent))]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *program, "fit", *given], env=environment, capture_output=True, text=True, timeout=LIMIT
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out / LAST


def tensors(value: Any, name: str = "") -> Iterator[tuple[str, torch.Tensor]]:
    if isinstance(value, torch.Tensor):
        yield name, value
    elif isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from tensors(part, f"{name}.{key}")


def furthest(one: Path, other: Path, *parts: str) -> float:
    """The largest difference between two checkpoints, which hold the same tensors."""
    both = [{part: read_checkpoint(path)[part] for part in parts or ("state_dict",)} for path in (one, other)]
    first, second = (dict(tensors(part)) for part in both)
    assert first.keys() == second.keys()
    return max((value - second[name]).abs().max().item() for name, value in first.items())


@pytest.mark.slow
def test_stage_one_goes_from_two_processes_to_one_and_back(toy_root, tmp_path):
    whole = fit([], toy_root, tmp_path / "whole", *STAGE1, "trainer.max_steps=3")
    two = fit(TORCHRUN, toy_root, tmp_path / "two", *STAGE1, "trainer=fsdp", "trainer.max_steps=1", "test=false")
    assert len(list(two.parent.glob("*.shards/*.safetensors"))) == 2
    one = fit([], toy_root, tmp_path / "one", *STAGE1, "trainer.max_steps=2", f"ckpt_path={two}", "test=false")
    assert not list(one.parent.glob("*.shards"))
    again = fit([], toy_root, tmp_path / "again", *STAGE1, *FSDP, "trainer.max_steps=3", f"ckpt_path={one}")
    assert read_checkpoint(again)["global_step"] == 3
    assert furthest(whole, again) < 1e-5
    scores = [strict_json(path.parents[1] / "metrics.json")["test"]["model"] for path in (whole, again)]
    assert scores[1]["full"]["novel"] == pytest.approx(scores[0]["full"]["novel"], rel=1e-4)
    weights = [load_file(path.parents[1] / "weights/model.safetensors") for path in (whole, again)]
    assert weights[0].keys() == weights[1].keys()


@pytest.mark.slow
def test_stage_two_with_averages_trains_as_with_ddp_and_goes_on_with_another_number_of_processes(pipeline, tmp_path):
    """Both processes draw what they draw with DDP."""
    given = [*STAGE2, f"model.autoreconstructor_checkpoint={pipeline.var / LAST}", "test=false"]
    two = fit(TORCHRUN, pipeline.toy, tmp_path / "two", *given, "trainer=fsdp", "trainer.max_steps=2")
    ddp = fit(TORCHRUN, pipeline.toy, tmp_path / "ddp", *given, "trainer=ddp", "trainer.max_steps=2")
    assert furthest(ddp, two, "state_dict", "current_model_state", "averaging_state", "optimizer_states") < 1e-4
    assert (two.stat().st_size, len(list(two.parent.glob("*.shards")))) < (ddp.stat().st_size, 2)
    ends = []
    for begun in (two, ddp):
        name = begun.parents[1].name
        one = fit([], pipeline.toy, tmp_path / f"{name}-1", *given, "trainer.max_steps=3", f"ckpt_path={begun}")
        more = [*(FSDP if begun == two else ["trainer=ddp", "trainer.devices=2"]), "trainer.max_steps=4"]
        ends.append(fit([], pipeline.toy, tmp_path / f"{name}-2", *given, *more, f"ckpt_path={one}"))
    assert furthest(*ends, "state_dict", "current_model_state", "optimizer_states") < 1e-4


def divided(path: Path, value: float = 1.0, rows: int = 2) -> None:
    """A checkpoint as two processes leave it: a tensor in two files, two rows in each; the second begins at `rows`."""
    folder = path.parent / f"{path.stem}-{value}.shards"
    folder.mkdir()
    for number in range(2):
        offsets = f'{{"state_dict.w": {{"saved_offsets": [{rows * number}, 0]}}}}'
        held = {"state_dict.w": torch.full((2, 3), value + number)}
        save_file(held, folder / f"shard-{number}.safetensors", {"DCP_SHARDING_INFO": offsets})
    files = {file.name: sha256_of(file) for file in folder.iterdir()}
    whole = {"state_dict": {"w": f"{DIVIDED}state_dict.w", "b": torch.zeros(2)}, "steps": [1, (2,)]}
    CheckpointFiles().save_checkpoint(whole | {SHARDS: {"folder": folder.name, "files": files}}, path)


def test_shards_are_read_as_one_checkpoint(tmp_path):
    divided(tmp_path / "last.ckpt")
    contents = read_checkpoint(tmp_path / "last.ckpt")
    assert contents["state_dict"]["w"].tolist() == [[1.0] * 3] * 2 + [[2.0] * 3] * 2
    assert contents["steps"] == [1, (2,)]
    assert SHARDS not in contents


@pytest.mark.parametrize("damage", ["changed", "removed", "all removed"])
def test_a_damaged_shard_is_found_and_an_earlier_checkpoint_taken(tmp_path, damage):
    for name in ("previous", "last"):
        divided(tmp_path / f"{name}.ckpt")
    folder = tmp_path / "last-1.0.shards"
    shard = folder / "shard-1.safetensors"
    if damage == "changed":
        content = bytearray(shard.read_bytes())
        content[-1] ^= 1
        shard.write_bytes(content)
    else:
        shard.unlink()
    if damage == "all removed":
        (folder / "shard-0.safetensors").unlink()
        folder.rmdir()
    with pytest.raises(WeightsError, match=r"shard-\d\.safetensors is missing or another"):
        check_whole(tmp_path / "last.ckpt")
    with pytest.raises(WeightsError):
        read_checkpoint(tmp_path / "last.ckpt")
    assert newest_whole(tmp_path / "last.ckpt") == tmp_path / "previous.ckpt"


def test_shards_that_no_checkpoint_names_are_removed(tmp_path):
    for value in (1.0, 2.0):
        divided(tmp_path / "last.ckpt", value)
    remove_unused_shards(tmp_path)
    assert [path.name for path in tmp_path.glob("*.shards")] == ["last-2.0.shards"]
    assert read_checkpoint(tmp_path / "last.ckpt")["state_dict"]["w"][0, 0] == 2


def test_shards_that_say_they_are_larger_than_their_files_are_refused(tmp_path):
    divided(tmp_path / "last.ckpt", rows=2**20)
    with pytest.raises(WeightsError, match=r"its tensors are larger than the files in .*last-1\.0\.shards"):
        read_checkpoint(tmp_path / "last.ckpt")


def test_a_checkpoint_cannot_name_files_elsewhere(tmp_path):
    (tmp_path / "run").mkdir()
    divided(tmp_path / "elsewhere.ckpt")
    held = torch.load(tmp_path / "elsewhere.ckpt", weights_only=True)
    held[SHARDS]["folder"] = "../elsewhere-1.0.shards"
    CheckpointFiles().save_checkpoint(held, tmp_path / "run/last.ckpt")
    with pytest.raises(WeightsError):
        read_checkpoint(tmp_path / "run/last.ckpt")


@pytest.mark.parametrize("option", ["ddp", "fsdp"])
def test_launchers_say_how_many_processes_there_are(monkeypatch, option):
    for name in ("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE", "SLURM_NTASKS_PER_NODE", "SLURM_NNODES"):
        monkeypatch.delenv(name, raising=False)
    trainer = compose_config("fit", f"trainer={option}").trainer
    assert (trainer.devices, trainer.num_nodes) == ("auto", 1)
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", "8")
    monkeypatch.setenv("SLURM_NNODES", "3")
    slurm = compose_config("fit", "trainer=slurm").trainer
    assert (trainer.devices, trainer.num_nodes) == (slurm.devices, slurm.num_nodes) == (8, 3)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    monkeypatch.setenv("GROUP_WORLD_SIZE", "2")
    assert (trainer.devices, trainer.num_nodes) == (4, 2)


def test_undivided_parameters_are_refused():
    config = compose_config("fit", "experiment=toy_var", *SMALL, "model.channels_last=true")
    module = instantiate(config.model, _convert_="all")
    with pytest.raises(CompleteSplatError, match=r"set model\.channels_last=false"):
        _refuse_undivided(module)
    module = instantiate(compose_config("fit", "experiment=toy_var", *SMALL).model, _convert_="all")
    _refuse_undivided(module)
    module.more = torch.nn.Linear(1, 1)
    with pytest.raises(CompleteSplatError, match=r"more\.weight of ReconstructionModule is not divided"):
        _refuse_undivided(module)
