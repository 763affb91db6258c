"""What shells complete: words, and real bash."""

import shutil
import subprocess
import sys

import pytest

from completesplat.cli import VERBS
from completesplat.settings.options import SCRIPTS, candidates


def completed(*words: str) -> list[str]:
    return candidates(words, VERBS)


def test_verbs_tasks_groups_options_and_settings_are_completed():
    assert completed("pre") == ["predict"]
    assert completed("completion", "") == ["bash", "zsh", "fish"]
    assert completed("data", "ch") == ["check"]
    assert completed("fit", "experiment=toy_v")[0] == "experiment=toy_var"
    assert completed("fit", "optimizer.l") == ["optimizer.lr="]
    assert completed("fit", "opt") == ["optimized_metric=", "optimizer.lr=", "optimizer.fused=", "optimizer="]
    assert "data.root=" in completed("fit", "data.")
    assert "data.category=" not in completed("fit", "data=toy_rooms", "data.")
    assert completed("predict", "sam") == ["samples=", "sampler="]
    assert completed("predict", "maps=") == ["maps=true", "maps=false"]
    assert "runs=" in completed("report", "html", "r")
    assert completed("predict", "image=ph") == completed("nonsense", "x") == []
    assert not any("_target_" in word or "hydra" in word for word in completed("fit", "model."))


@pytest.mark.processes
@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
@pytest.mark.parametrize(
    ("line", "replies"),
    [
        ("completesplat pred", ["predict"]),
        ("completesplat fit ablation=no_sk", ["no_skips"]),
        ("completesplat fit optimizer.l", ["optimizer.lr="]),
        ("completesplat fit experiment=toy_var data.ro", ["data.root="]),
        ("completesplat predict photo", []),
    ],
)
def test_bash_completes(tmp_path, line, replies):
    program = tmp_path / "bin/completesplat"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -c "from completesplat.cli import main; main()" "$@"\n')
    program.chmod(0o755)
    asked = f"""export PATH={program.parent}:$PATH
        eval "$(completesplat completion bash)"
        complete -p completesplat >/dev/null || exit 3
        COMP_LINE={line!r} COMP_POINT={len(line)}
        _completesplat
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == replies


@pytest.mark.parametrize("shell", list(SCRIPTS))
def test_each_shell_can_read_its_script(shell):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    subprocess.run([shell, "-n"], input=SCRIPTS[shell], text=True, check=True)


def test_a_shell_that_is_not_known_is_refused(command):
    for words in ([], ["tcsh"], ["bash", "zsh"]):
        finished = command("completion", *words)
        assert (finished.status, finished.err) == (2, "error: name a shell: completesplat completion bash|zsh|fish\n")
    assert command("completion", "fish").out == SCRIPTS["fish"]
