"""A sweep whose jobs SLURM starts, here a `sbatch` that runs its script at once."""

import csv
import os
import stat
import subprocess
import sys

import pytest
from support import LIMIT, SMALL, script, strict_json

PYTHON = f"#!{sys.executable}\n"
SBATCH = '''"""Start all jobs of an array, or the one job, of the script of the last argument, and print the number.

They wait, as in a queue, until whoever submits them has put everything in its place.
"""
import os, re, subprocess, sys
script = sys.argv[-1]
options = dict(re.findall(r"^#SBATCH --([\\w-]+)=(\\S+)", open(script).read(), re.M))
first, last = re.match(r"(\\d+)-(\\d+)", options.get("array", "0-0")).groups()
number = str(os.getpid())
for task in range(int(first), int(last) + 1):
    tasks = options.get("ntasks-per-node", "1")
    told = {"SLURM_JOB_ID": f"{number}{task}", "SLURM_JOB_NAME": options["job-name"], "SLURM_NTASKS": tasks}
    told |= {"SLURM_NTASKS_PER_NODE": tasks, "SLURM_NNODES": options["nodes"], "SLURM_JOB_NUM_NODES": "1"}
    if "array" in options:
        told |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": str(task)}
    job = f"{number}_{task}" if "array" in options else number
    waiting = f"[ ! -e {os.path.dirname(script)}/{job}/{job}_submitted.pkl ] && kill -0 {os.getppid()}"
    run = ["bash", "-c", f"while {waiting}; do sleep 0.1; done; exec bash {script}"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.Popen(run, env=os.environ | told, start_new_session=True, **silent)
print("Submitted batch job", number)
'''
SRUN = '''"""Run a program once for each task, as srun does on one node."""
import os, subprocess, sys
count = int(os.environ["SLURM_NTASKS"])
program = sys.argv[next(i for i, argument in enumerate(sys.argv) if "/python" in argument) :]
shared = {"SLURM_STEP_NUM_TASKS": str(count), "SLURM_NODEID": "0", "SLURM_NODELIST": "localhost"}
log = sys.argv[sys.argv.index("--error") + 1]
job, task = (os.environ.get(f"SLURM_ARRAY_{name}_ID", "0") for name in ("JOB", "TASK"))
processes = []
for rank in range(count):
    told = shared | {"SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank)}
    with open(log.replace("%A", job).replace("%a", task).replace("%t", str(rank)), "w") as file:
        processes.append(subprocess.Popen(program, env=os.environ | told, stdout=file, stderr=file))
sys.exit(max(process.wait() for process in processes))
'''


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """SLURM's programs, first in the PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in {"sbatch": SBATCH, "srun": SRUN, "sacct": "", "scontrol": "", "scancel": ""}.items():
        (folder / name).write_text(PYTHON + text)
        (folder / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")  # asked of `scontrol` by Lightning otherwise
    return folder


@pytest.mark.slow
def test_slurm_runs_the_jobs_of_a_sweep_each_with_two_processes(toy_root, tmp_path, cluster):
    out = tmp_path / "sweep"
    given = ["fit", "-m", "experiment=toy_var", f"data.root={toy_root}", *SMALL, "data.workers=0", f"out={out}"]
    given += ["trainer.max_steps=1", "callbacks.images=null", "rasterizer=reference", "trainer=slurm", "seed=0,1"]
    given += ["hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=10", "hydra.launcher.tasks_per_node=2"]
    program = [sys.executable, str(script(tmp_path)), *given, "trainer.precision=32-true"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(program, env=environment, capture_output=True, text=True, timeout=LIMIT, cwd=tmp_path)
    logs = "".join(path.read_text()[-2000:] for path in out.glob(".submitit/*/*_log.err"))
    assert done.returncode == 0, done.stderr[-3000:] + logs
    with (out / "summary.csv").open(newline="") as file:
        assert [row["seeds"] for row in csv.DictReader(file) if row["seeds"]] == ["2"]
    for seed in (0, 1):
        metrics = strict_json(out / f"seed-{seed}/metrics.json")
        assert (metrics["steps"], metrics["data.batch_per_process"]) == (1, 1)
    assert len(list(out.glob(".submitit/*/*_result.pkl"))) == 4
