"""What a run leaves for Weights & Biases, without a network."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from support import SMALL

wandb = pytest.importorskip("wandb")


BLOCK, FILE_HEADER, CHUNK_HEADER = 2**15, 7, 7


def records(data: bytes) -> Iterator[bytes]:
    """The records of a run's own file: LevelDB's log format (blocks of chunks with checksum, length, kind)."""
    position, record = FILE_HEADER, b""
    while position + CHUNK_HEADER <= len(data):
        if BLOCK - position % BLOCK < CHUNK_HEADER:  # The rest of a block is filled up.
            position += BLOCK - position % BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", data, position)
        record += data[position + CHUNK_HEADER : position + CHUNK_HEADER + length]
        position += CHUNK_HEADER + length
        if kind in (1, 4):  # The whole of a record, or the last part of it.
            yield record
            record = b""


def history(path: Path) -> list[dict]:
    """The rows that were logged."""
    from wandb.proto.wandb_internal_pb2 import Record

    found = [Record.FromString(record) for record in records(path.read_bytes())]
    rows = [record.history.item for record in found if record.WhichOneof("record_type") == "history"]
    return [{"/".join(i.nested_key) or i.key: json.loads(i.value_json) for i in items} for items in rows]


def test_an_offline_run_holds_pictures_histograms_and_rows(command, pipeline, tmp_path, monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    settings = ["experiment=toy_var", f"data.root={pipeline.toy}", *SMALL, "test=false"]
    finished = command("fit", *settings, "logger=wandb", "wandb.project=some", f"out={tmp_path / 'run'}")
    assert finished.status == 0, finished.err
    (folder,) = (tmp_path / "run/wandb").glob("offline-run-*")
    (picture,) = folder.glob("files/media/images/pictures_*.png")
    drawn = tmp_path / "run/pictures/step_000002.png"
    assert list(Image.open(picture).getdata()) == list(Image.open(drawn).getdata())
    (file,) = folder.glob("run-*.wandb")
    rows = history(file)
    (shown,) = [row for row in rows if "pictures/path" in row]
    assert (shown["trainer/global_step"], shown["pictures/path"]) == (1, f"media/images/{picture.name}")
    for name in ("opacity", "log10_scale", "depth"):
        assert shown[f"histograms/{name}/_type"] == "histogram"
        # One validation scene of 32 x 32 pixels in two layers; scales have three axes.
        assert sum(shown[f"histograms/{name}/values"]) == 32 * 32 * 2 * (3 if name == "log10_scale" else 1)
    (scalars,) = [row for row in rows if "gaussians/depth_p50" in row]
    assert {f"kl/channel_{i}" for i in range(4)} <= scalars.keys()


def test_stage_two_adds_its_samples(command, pipeline, tmp_path, monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    stage1 = f"model.autoreconstructor_checkpoint={pipeline.var / 'checkpoints/last.ckpt'}"
    settings = ["experiment=toy_diffusion", stage1, "sampler.steps=2", f"data.root={pipeline.toy}", *SMALL]
    finished = command("fit", *settings, "test=false", "logger=wandb", f"out={tmp_path / 'run'}")
    assert finished.status == 0, finished.err
    (folder,) = (tmp_path / "run/wandb").glob("offline-run-*")
    for name, kind in (("samples", "step"), ("denoising", "strip")):
        (picture,) = folder.glob(f"files/media/images/{name}_*.png")
        drawn = tmp_path / f"run/samples/{kind}_000002.png"
        assert list(Image.open(picture).getdata()) == list(Image.open(drawn).getdata())
    (file,) = folder.glob("run-*.wandb")
    rows = history(file)
    (shown,) = [row for row in rows if "samples/path" in row]
    assert shown["denoising/_type"] == "image-file"
    assert shown["trainer/global_step"] == 1
    (scalars,) = [row for row in rows if "samples/diversity" in row]
    assert {"samples/psnr", "samples/psnr_of_mean"} <= scalars.keys()
