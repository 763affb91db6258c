"""`make gpu-weights`: a rehearsal at tiny sizes, cut in stage 1, goes on and gives weights that open."""

import os
import runpy
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file
from support import strict_json
from written_commands import ROOT

import completesplat

SCRIPT = ROOT / "notebooks/gpu_weights.py"
GPU_WEIGHTS = SimpleNamespace(**runpy.run_path(str(SCRIPT)))


def test_times_so_far_are_kept_and_shares_are_of_the_time_after_the_data(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    clock = GPU_WEIGHTS.Clock(tmp_path, minutes=10)
    now[0] += 100
    clock.end_data()
    now[0] += 20
    assert clock.left_until(0.5) == pytest.approx(230)
    now[0] = 5000.0  # another day: the time between does not count
    clock = GPU_WEIGHTS.Clock(tmp_path, minutes=10)
    now[0] += 60
    assert clock.left_until(0.5) == pytest.approx(170)


def test_seconds_are_written_as_lightning_takes_them():
    assert GPU_WEIGHTS.clock_time(3725.9) == "00:01:02:05"
    assert GPU_WEIGHTS.clock_time(0) == "00:00:00:01"


def test_parts_end_in_their_order_and_leave_time_for_scores():
    ends = GPU_WEIGHTS.ENDS
    assert 0 < ends["early"] < ends["stage1"] < ends["stage2"] < 1
    assert GPU_WEIGHTS.LAST_STEPS["early"] < GPU_WEIGHTS.LAST_STEPS["stage1"]


@pytest.mark.slow
@pytest.mark.processes
def test_a_rehearsal_that_is_cut_goes_on_and_gives_weights_that_open(tmp_path):
    inputs, out = tmp_path / "inputs", tmp_path / "out"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    packing = [sys.executable, ROOT / "notebooks/gpu_weights_inputs.py", inputs, "--small"]
    subprocess.run(packing, env=environment, check=True)
    command = [sys.executable, SCRIPT, inputs, out, "--minutes", "60", "--small"]
    process = subprocess.Popen(command, env=environment)
    while not (out / "stage1/checkpoints").is_dir():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 1
    last = out / "stage1/checkpoints/last.ckpt"
    cut = GPU_WEIGHTS.progress_of(last)
    assert GPU_WEIGHTS.LAST_STEPS["early"] < cut.steps < GPU_WEIGHTS.LAST_STEPS["stage1"]
    assert not (out / "stage1.txt").exists()
    done = {path: path.stat().st_mtime_ns for path in (out / f"{part}.txt" for part in ("solids", "store", "early"))}
    seconds = float((out / "seconds.txt").read_text())
    subprocess.run(command, env=environment, check=True)
    assert {path: path.stat().st_mtime_ns for path in done} == done
    whole = GPU_WEIGHTS.progress_of(last)
    assert whole.steps == GPU_WEIGHTS.LAST_STEPS["stage1"]
    assert whole.seconds > cut.seconds
    assert float((out / "seconds.txt").read_text()) > seconds
    _check_results(out, tmp_path / "joined")


def _check_results(out, joined):
    """Join the small files, open them, and compare with stage 2's weights."""
    results = out / "results"
    facts = strict_json(results / "facts.json")
    assert facts["stage2"]["steps"] == GPU_WEIGHTS.LAST_STEPS["stage2"]
    assert facts["look"]["weight"] in (GPU_WEIGHTS.PERCEPTUAL, GPU_WEIGHTS.PERCEPTUAL / 2)
    assert strict_json(results / "metrics.json")
    assert max(path.stat().st_size for path in results.iterdir()) <= GPU_WEIGHTS.PART_BYTES
    joined.mkdir()
    (joined / "config.json").write_bytes((results / "config.json").read_bytes())
    parts = sorted(results.glob("model.safetensors.*"))
    (joined / "model.safetensors").write_bytes(b"".join(path.read_bytes() for path in parts))
    trained = load_file(out / "stage2/weights/model.safetensors")
    general = load_file(ROOT / "completesplat/weights/general/model.safetensors")
    changed = 0
    for name, tensor in load_file(joined / "model.safetensors").items():
        if name not in GPU_WEIGHTS.CAMERA:
            torch.testing.assert_close(tensor.float(), trained[name].half().float())
            changed += not torch.equal(tensor, general[name])
    assert changed > 100
    photo = torch.rand(3, 32, 32, generator=torch.manual_seed(0))
    (scene,) = completesplat.CompleteSplat.from_pretrained(joined)(photo)
    assert scene.means.isfinite().all()
