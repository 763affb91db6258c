"""The wheel: what is in it, and that a commit gives the same one (`test_scenarios` uses it)."""

import re
import subprocess
from email import message_from_bytes
from hashlib import sha256
from pathlib import Path
from zipfile import ZipFile

import meshes
import numpy as np
import pytest
from PIL import Image
from support import strict_json
from written_commands import ROOT

from completesplat.weights import shipped

pytestmark = pytest.mark.slow
FOLDERS = {"completesplat": "completesplat", "conf": "completesplat/conf"}
LINK = re.compile(r"\]\(([^)\s]+)\)")


def files(folder: str) -> set[str]:
    """Return the files of a folder of the repository under the names that they have in the wheel."""
    paths = [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {f"{FOLDERS[folder]}/{path.relative_to(ROOT / folder).as_posix()}" for path in paths}


def test_the_wheel_has_the_package_its_settings_and_weights_and_no_link_that_leads_nowhere(installed):
    with ZipFile(installed.wheel) as wheel:
        names = set(wheel.namelist())
        metadata = message_from_bytes(wheel.read(next(name for name in names if name.endswith(".dist-info/METADATA"))))
    package = {name for name in names if ".dist-info/" not in name}
    assert package == files("completesplat") | files("conf")
    weights = {f"completesplat/weights/{name}/model.safetensors" for name in shipped()}
    assert {"completesplat/py.typed", *weights} <= package
    assert Path(installed.wheel).stat().st_size < 75e6
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    description = metadata.get_payload()
    readme = (ROOT / "README.md").read_text()
    assert [link for link in LINK.findall(description) if "://" not in link] == []
    badge = {link for link in LINK.findall(readme) if link.startswith("https://colab.")}
    assert {link for link in LINK.findall(readme) if "://" in link} - badge <= set(LINK.findall(description))
    commands = [line for line in readme.splitlines() if line.startswith(("completesplat", "##"))]
    assert [line for line in description.splitlines() if line.startswith(("completesplat", "##"))] == commands
    assert "![" not in description
    assert "*A photograph of an apple" not in description


def test_the_installed_wheel_draws_a_scan_and_a_glb_in_an_empty_folder_without_blender(
    installed, tmp_path, monkeypatch
):
    monkeypatch.setenv("COMPLETESPLAT_BLENDER", str(tmp_path / "none"))  # refused if it is looked for
    meshes.write_scan(tmp_path / "MESHES/scan")
    meshes.write_ball(tmp_path / "MESHES/ball.glb")
    meshes.write_ball(tmp_path / "MESHES/steel.glb", pbr={"metallicFactor": 1.0})
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1.0}}
    meshes.write_ball(tmp_path / "MESHES/glass.glb", extensions=glass)
    settings = ["up=z", "floor=none", "views=4", "size=32", "samples=4", "workers=1", "out=RENDERS"]
    printed = installed.run(tmp_path, "completesplat", "data", "render", "meshes=MESHES", *settings)
    lines = [line for line in printed.splitlines() if "renderer=blender" in line]
    assert len(lines) == 2
    for line, name in zip(sorted(lines), ("glass: glass", "steel: metal"), strict=True):
        assert f"{name}: drawn as plain colours; renderer=blender draws them" in line
    scenes = {path.parent.name: strict_json(path) for path in (tmp_path / "RENDERS/rendered").glob("*/object.json")}
    assert sorted(scenes) == ["ball", "glass", "scan_meshes_model", "steel"]
    tall = []
    for name in ("scan_meshes_model", "ball"):
        for mask in (tmp_path / "RENDERS/rendered" / name / "masks").iterdir():
            rows, columns = np.nonzero(np.asarray(Image.open(mask)) > 127)
            tall.append(np.ptp(rows) > 1.2 * np.ptp(columns))
    assert tall == 4 * [True] + 4 * [False]


def test_a_commit_gives_the_same_release_in_another_folder_with_other_permissions(tmp_path):
    """The release is of the last commit: what is not committed is in neither."""
    releases = []
    for name, mask in (("a", 0o022), ("b", 0o077)):
        folder = tmp_path / name
        for command in (["git", "clone", "--quiet", ROOT, folder], ["make", "--silent", "-C", folder, "release"]):
            subprocess.run(command, check=True, umask=mask, stdout=subprocess.DEVNULL)
        files = {path.name: sha256(path.read_bytes()).hexdigest() for path in (folder / "dist").iterdir()}
        sums = files.pop("SHA256SUMS")
        listed = [line.split() for line in (folder / "dist/SHA256SUMS").read_text().splitlines()]
        assert files == {name: value for value, name in listed}
        releases.append((files, sums))
    assert releases[0] == releases[1]
    assert sorted(name.rpartition("0.1.0")[2] for name in files) == ["-py3-none-any.whl", ".cdx.json", ".tar.gz"]
    bill = strict_json(folder / f"dist/{next(name for name in files if name.endswith('.json'))}")
    assert bill["bomFormat"] == "CycloneDX"
    assert bill["metadata"]["component"]["version"] == "0.1.0"
    assert {"lightning", "hydra-core", "numpy"} <= {component["name"] for component in bill["components"]}
