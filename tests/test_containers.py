"""The files for containers and conda name what exists; a workflow builds them, because no engine is here."""

import re
import tomllib
from pathlib import Path

import yaml

import completesplat

ROOT = Path(completesplat.__file__).parents[1]
FOLDER = ROOT / ".docker"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DOCKERFILE, WORKFLOW = (FOLDER / "Dockerfile").read_text(), (ROOT / ".github/workflows/docker.yml").read_text()
OLDEST = PROJECT["requires-python"].removeprefix(">=")


def test_the_image_takes_all_that_the_package_is_made_of():
    lines = (FOLDER / "Dockerfile.dockerignore").read_text().splitlines()
    taken = [line[1:] for line in lines if line.startswith("!")]
    assert lines.index("*") < lines.index("!completesplat")
    assert {path.split("/")[0] for path in PROJECT["license-files"]} <= set(taken)
    assert {"pyproject.toml", "README.md", "completesplat", "conf"} <= set(taken)
    assert all((ROOT / path).exists() for path in taken)


def test_one_argument_chooses_the_device_and_no_image_runs_as_root():
    stages = re.findall(r"^FROM \S+ AS (\w+)$", DOCKERFILE, re.MULTILINE)
    assert stages == yaml.safe_load(WORKFLOW)["jobs"]["image"]["strategy"]["matrix"]["device"]
    assert DOCKERFILE.index("ARG DEVICE=cpu") < DOCKERFILE.index("FROM ${DEVICE}")
    (user,) = re.findall(r"^USER (\w+)$", DOCKERFILE, re.MULTILINE)
    assert user != "root"
    assert DOCKERFILE.index("USER splat") < DOCKERFILE.index('ENTRYPOINT ["completesplat"]')
    assert "completesplat" in PROJECT["scripts"]
    assert f"FROM python:{OLDEST}-slim" in DOCKERFILE


def test_both_install_extras_that_exist_and_conda_the_oldest_python():
    *packages, pip = yaml.safe_load((FOLDER / "environment.yml").read_text())["dependencies"]
    assert f"python={OLDEST}" in packages
    (requirement,) = pip["pip"]
    path, extras = re.fullmatch(r"(.*)\[(.*)\]", requirement).groups()
    assert (FOLDER / path).resolve() == ROOT
    named = {extra for line in [extras, *re.findall(r"EXTRAS=(\S+)", DOCKERFILE)] for extra in line.split(",")}
    assert named <= set(PROJECT["optional-dependencies"])
