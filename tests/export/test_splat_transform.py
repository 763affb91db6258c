import shutil

import pytest
from fake_converter import calls, install

from completesplat.errors import CompleteSplatError
from completesplat.export import splat_transform
from completesplat.export.splat_transform import PACKAGE, convert, find_splat_transform

pytestmark = pytest.mark.processes


@pytest.fixture
def bin_folder(tmp_path, monkeypatch):
    """A folder that comes first on PATH, before a system without node."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("sh", "cp", "sleep", "cat", "touch"):
        (tools / name).symlink_to(shutil.which(name))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{tools}")
    return tmp_path / "bin"


def test_without_node_the_message_names_what_to_install(bin_folder):
    with pytest.raises(CompleteSplatError, match=r"need Node\.js 20 .* ply, .* spz and glb need nothing"):
        find_splat_transform()


def test_the_program_on_path_comes_first_else_npx_provides_the_pinned_package(bin_folder, tmp_path):
    elsewhere = install(tmp_path / "npm", "splat-transform")
    npx = install(bin_folder, "npx", f'echo "$@" >> "$0.log"\necho {elsewhere}')
    assert find_splat_transform() == str(elsewhere)
    assert calls(npx) == [f"--yes --package={PACKAGE} -c command -v splat-transform"]
    assert PACKAGE.endswith("@2.7.1")
    program = install(bin_folder, "splat-transform")
    assert find_splat_transform() == str(program)
    assert calls(program) == ["--version"]
    assert len(calls(npx)) == 1


@pytest.mark.parametrize(
    ("name", "script", "message"),
    [
        ("npx", "#!/bin/sh\necho npm warn a hint >&2; echo npm error network >&2; exit 1", "1: network$"),
        ("splat-transform", "#!/bin/sh\necho node is too old >&2; exit 3", "failed with status 3: node is too old"),
        ("splat-transform", "#!/no/such/interpreter\n", "splat-transform does not start"),
    ],
)
def test_programs_that_do_not_start_are_refused_early(bin_folder, name, script, message):
    install(bin_folder, name).write_text(script)
    with pytest.raises(CompleteSplatError, match=message):
        find_splat_transform()


def test_a_file_is_converted_in_place_of_an_older_one(bin_folder, tmp_path):
    program = install(bin_folder, "splat-transform")
    (tmp_path / "a.ply").write_text("splats")
    (tmp_path / "a.spz").write_text("older")
    convert(str(program), tmp_path / "a.ply", tmp_path / "a.spz", ["--rotate", "0,0,180"])
    assert (tmp_path / "a.spz").read_text() == "splats"
    (call,) = calls(program)
    assert call.startswith(f"--quiet --overwrite --rotate 0,0,180 {tmp_path / 'a.ply'} ")
    assert call.endswith(".spz")  # by which it knows the format


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo '    at main (x.js:1)' >&2; echo 'no GPU\nat all' >&2; exit 1", "failed with status 1: no GPU at all$"),
        ("exit 9", "failed with status 9: it does not say why"),
        ("exit 0", "has not written a.spz"),
    ],
)
def test_a_failure_is_one_line_and_leaves_the_older_file(bin_folder, tmp_path, script, message):
    program = install(bin_folder, "splat-transform", script)
    (tmp_path / "a.ply").write_text("splats")
    (tmp_path / "a.spz").write_text("older")
    with pytest.raises(CompleteSplatError, match=message) as caught:
        convert(str(program), tmp_path / "a.ply", tmp_path / "a.spz")
    assert "\n" not in str(caught.value)
    assert (tmp_path / "a.spz").read_text() == "older"


def test_slow_converters_are_killed_with_their_children(bin_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(splat_transform, "LIMIT_SECONDS", 0.3)
    # Would write the file after a minute, and holds the pipes open until then.
    program = install(bin_folder, "splat-transform", f"(sleep 60; touch {tmp_path / 'late'}) & sleep 100")
    with pytest.raises(CompleteSplatError, match=r"splat-transform has not finished within 0\.3 seconds"):
        convert(str(program), tmp_path / "a.ply", tmp_path / "a.spz")
    assert not (tmp_path / "late").exists()
