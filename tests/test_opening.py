"""Names of weights: which file is meant, and whether it is whole."""

import shutil
import socket
import subprocess
import time

import pytest
from support import flip_bit, hub_snapshot

from completesplat import weights
from completesplat.errors import WeightsError
from completesplat.generator import CompleteSplat
from completesplat.weights import CONFIG_FILE, SUMS_FILE, WEIGHTS_FILE, locate, shipped, write_sums


@pytest.fixture
def folder(tiny_weights, tmp_path):
    return shutil.copytree(tiny_weights, tmp_path / "copy")


def test_checksums_are_those_of_sha256sum(folder):
    program = ["sha256sum"] if shutil.which("sha256sum") else ["shasum", "-a", "256"]  # of Linux, of macOS
    checked = subprocess.run([*program, "--check", SUMS_FILE], cwd=folder, capture_output=True, text=True)
    assert checked.returncode == 0
    assert checked.stdout.splitlines() == [f"{CONFIG_FILE}: OK", f"{WEIGHTS_FILE}: OK"]


def test_a_flipped_bit_is_refused_until_the_checksums_are_rewritten(folder):
    flip_bit(folder / WEIGHTS_FILE)
    with pytest.raises(WeightsError, match=rf"{WEIGHTS_FILE}: damaged or changed.*remove {SUMS_FILE}"):
        CompleteSplat.from_pretrained(folder)
    write_sums(folder)
    assert locate(folder) == folder / WEIGHTS_FILE


def test_checksums_must_cover_both_files_or_be_missing(folder):
    sums = folder / SUMS_FILE
    sums.write_text("".join(sums.read_text().splitlines(keepends=True)[:1]))
    with pytest.raises(WeightsError, match=f"is not the one in {SUMS_FILE}"):
        locate(folder)
    sums.unlink()
    assert locate(folder) == folder / WEIGHTS_FILE


def test_shipped_weights_are_named_first(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "SHIPPED", tmp_path)
    assert list(shipped()) == ["copy"]
    assert locate("copy") == tmp_path / "copy" / WEIGHTS_FILE
    # Data may lie in a folder of the same name where somebody works.
    monkeypatch.chdir(tmp_path / "copy")
    (tmp_path / "copy" / "copy").mkdir()
    assert locate("copy") == tmp_path / "copy" / WEIGHTS_FILE
    assert CompleteSplat.from_pretrained(".").image_size
    with pytest.raises(WeightsError, match="nothing_of_this_name: no such folder; with the package come copy"):
        locate("nothing_of_this_name")


def test_a_hub_repository_in_the_cache_needs_no_network(tiny_weights, tmp_path, monkeypatch):
    snapshot = shutil.copytree(tiny_weights, hub_snapshot(monkeypatch, tmp_path / "hub", "some/splats"))
    assert locate("some/splats") == snapshot / WEIGHTS_FILE
    with pytest.raises(WeightsError, match="other/splats: no folder here, and not to be had from the hub"):
        locate("other/splats")


@pytest.mark.parametrize("name", ["other/splats", "splatter_image:objaverse"])
def test_without_a_network_a_name_on_the_hub_is_refused_at_once(name, tmp_path, monkeypatch, caplog):
    import huggingface_hub.constants

    def unknown(*_, **__):
        raise socket.gaierror(-3, "Temporary failure in name resolution")

    caplog.set_level("INFO")
    waits = []
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    monkeypatch.setattr(time, "sleep", waits.append)
    with pytest.raises(WeightsError, match=r"not to be had from the hub \(.*name resolution"):
        CompleteSplat.from_pretrained(name)
    assert waits == []
    assert [record.getMessage().partition("; ")[2] for record in caplog.records] == ["asking the Hugging Face hub"]


def test_published_weights_that_the_hubs_copy_lacks_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: str(tmp_path))
    with pytest.raises(
        WeightsError, match=r"splatter_image:tables: config_tables\.yaml or model_tables\.pth is not in"
    ):
        CompleteSplat.from_pretrained("splatter_image:tables")


def test_a_name_that_is_too_long_for_a_file_is_refused_in_a_short_line():
    for name in ("y" * 5000, "y" * 300 + "/x"):
        with pytest.raises(WeightsError, match=r"^y{200}") as caught:
            CompleteSplat.from_pretrained(name)
        assert len(str(caught.value)) < 1500
