from dataclasses import dataclass

import pytest
from support import call


@dataclass(frozen=True)
class Finished:
    """What a command left behind."""

    status: int
    out: str
    err: str


@pytest.fixture
def command(capfd, monkeypatch, tmp_path):
    """Run `completesplat` in this process, from an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> Finished:
        capfd.readouterr()
        status = call(monkeypatch, *arguments)
        return Finished(status, *capfd.readouterr())

    return run
