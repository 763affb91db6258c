"""Commands that add an extra, by where the package came from."""

import json
from types import SimpleNamespace

import pytest

from completesplat import installation

URL = "https://example.org/completesplat"


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, 'pip install "completesplat[view]"'),
        ({"url": "file:///a%20b/clone", "dir_info": {"editable": True}}, "pip install -e '/a b/clone[view]'"),
        ({"url": "file:///a/clone", "dir_info": {}}, "pip install '/a/clone[view]'"),
        ({"url": "file:///a/b-1-py3-none-any.whl", "archive_info": {}}, "pip install '/a/b-1-py3-none-any.whl[view]'"),
        ({"url": URL, "vcs_info": {"vcs": "git"}}, f'pip install "completesplat[view] @ git+{URL}"'),
    ],
)
def test_the_command_installs_from_where_the_package_came(monkeypatch, origin, command):
    text = None if origin is None else json.dumps(origin)
    monkeypatch.setattr(installation, "distribution", lambda name: SimpleNamespace(read_text=lambda file: text))
    assert installation.install_command("view") == command


def test_broken_records_are_as_none(monkeypatch):
    monkeypatch.setattr(installation, "distribution", lambda name: SimpleNamespace(read_text=lambda file: "{"))
    assert installation.install_command("view") == 'pip install "completesplat[view]"'
