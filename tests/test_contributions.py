"""New parts inside a clone: a data set, an ablation and a metric pass the tests that judge the whole tree."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = shutil.ignore_patterns(".git", ".venv", "outputs", "__pycache__", ".*_cache", "build", "dist")
JUDGES = ["test_architecture.py", "test_configs.py", "test_documents.py", "evaluation/test_paper_tables.py"]
NO_KL = """# @package _global_
# Latents are sampled, but nothing pulls them towards a normal distribution.
loss:
  terms:
    kl: null
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    return shutil.copytree(ROOT, tmp_path / "clone", ignore=LEFT_OUT)


def replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def add_data_set(clone: Path) -> None:
    """Move what `completesplat new dataset` wrote to the places that CONTRIBUTING.md names."""
    written = clone.parent
    module = clone / "completesplat/data/scannet/module.py"
    module.parent.mkdir()
    (module.parent / "__init__.py").write_text('"""ScanNet."""\n')
    shutil.move(written / "scannet.py", module)
    shutil.move(written / "conf/data/scannet.yaml", clone / "conf/data")
    replaced(clone / "conf/data/scannet.yaml", "_target_: scannet", "_target_: completesplat.data.scannet.module")


def add_metric(clone: Path) -> None:
    shutil.move(clone.parent / "edge_errors.py", clone / "completesplat/metrics")
    entry = "metrics:\n  edge_errors:\n    _target_: completesplat.metrics.edge_errors.EdgeErrors\n  psnr:\n"
    replaced(clone / "conf/evaluation/images.yaml", "metrics:\n  psnr:\n", entry)


@pytest.mark.processes
def test_a_data_set_an_ablation_a_metric_and_a_comment_pass_the_tests_of_the_tree(
    command: Callable, clone: Path
) -> None:
    for kind, name in (("dataset", "scannet"), ("metric", "edge_errors")):
        command.succeeds("new", kind, name)
    add_data_set(clone)
    add_metric(clone)
    (clone / "conf/ablation/no_kl.yaml").write_text(NO_KL)
    with (clone / "completesplat/scene.py").open("a") as scene:
        scene.write("# one more comment\n")
    judges = [f"tests/{name}" for name in JUDGES]
    environment = os.environ | {"PYTHONPATH": str(clone)}
    given = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", *judges]
    done = subprocess.run(given, cwd=clone, env=environment, capture_output=True, text=True)
    failed = re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE)
    assert (done.returncode, failed) == (0, []), done.stdout[-3000:]
    assert len(re.findall(r"^PASSED .*\[(?:ablation-)?no_kl\]", done.stdout, re.MULTILINE)) == 2
