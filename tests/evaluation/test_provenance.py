import os
import subprocess

from completesplat.evaluation import provenance


def test_a_repository_is_read_and_never_written_to(tmp_path, monkeypatch):
    """A run that is killed while git refreshes its index would leave a lock, and no commit could be made."""
    source = tmp_path / "package/module.py"
    source.parent.mkdir()
    source.write_text("a")
    monkeypatch.setattr(provenance, "__file__", str(source))
    assert provenance.git_commit() is None
    for given in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        author = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
        subprocess.run(["git", "-C", str(tmp_path), *author, *given], check=True)
    index = tmp_path / ".git/index"
    before = index.read_bytes()
    os.utime(source, (1e9, 1e9))  # which git would note in its index
    commit = provenance.git_commit() or ""
    assert len(commit) == 40
    source.write_text("b")
    assert provenance.git_commit() == f"{commit}-dirty"
    assert index.read_bytes() == before
