"""The wheel: what is in it, and that it works from an empty folder, as somebody has it who has nothing else."""

import re
import subprocess
from email import message_from_bytes
from functools import partial
from hashlib import sha256
from pathlib import Path
from zipfile import ZipFile

import pytest
from support import SMALL, strict_json
from written_commands import ROOT

from completesplat.weights import SHIPPED, shipped

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
    description, readme = metadata.get_payload(), (ROOT / "README.md").read_text()
    assert [link for link in LINK.findall(description) if "://" not in link] == []
    badge = {link for link in LINK.findall(readme) if link.startswith("https://colab.")}
    assert {link for link in LINK.findall(readme) if "://" in link} - badge <= set(LINK.findall(description))
    commands = [line for line in readme.splitlines() if line.startswith(("completesplat", "##"))]
    assert [line for line in description.splitlines() if line.startswith(("completesplat", "##"))] == commands
    assert "![" not in description
    assert "*A photograph of an apple" not in description


def test_the_installed_wheel_predicts_sweeps_and_writes_tables_from_an_empty_folder(installed, toy_root, tmp_path):
    run = partial(installed.run, tmp_path, "completesplat")
    place = installed.run(tmp_path, "python", "-c", "import completesplat; print(completesplat.__file__)")
    assert place.startswith(str(installed.environment))
    image = next(toy_root.glob("*/*/images/*.jpg"))
    run("predict", f"image={image}", "samples=1", "steps=2", "frames=2", "out=SCENES")
    couch = SHIPPED / "rendered_couches/held_out.jpg"
    run("predict", f"image={couch}", "weights=rendered_couches", "samples=1", "steps=2", "frames=2", "out=SCENES")
    for name in (image.stem, couch.stem):
        scenes = {path.name for path in (tmp_path / "SCENES" / name).iterdir()}
        assert scenes == {"sample_00.ply", "orbit_00.mp4", "sheet.png", "scene.json", "photo.png"}
    brief = [f"data.root={toy_root}", *SMALL, "callbacks.images=null"]
    run("fit", "-m", "experiment=toy_var", *brief, "seed=0,1", "out=SWEEP")
    assert [strict_json(tmp_path / f"SWEEP/seed-{seed}/metrics.json")["steps"] for seed in (0, 1)] == [2, 2]
    run("report", "runs=.", "out=TABLES")
    tables = {kind: (tmp_path / f"TABLES/tables.{kind}").read_text() for kind in ("md", "csv", "tex")}
    for text in tables.values():  # the paper's, and that of the sweep's jobs
        assert "Table 2" in text
        assert "images, 32 pixels" in text
    assert "SWEEP/seed-1" in tables["md"]


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
