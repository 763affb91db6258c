"""What the documents say of the repository is so: links, paths, targets of make, groups, versions, authors."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from written_commands import BLOCK, CHANGELOG, DOCUMENTS, README, ROOT, STUDIES

from completesplat.weights import shipped

LINK = re.compile(r"\]\(([^)\s]+)\)")
PATH = re.compile(r"`((?:completesplat|conf|tests|notebooks|\.ci)/[\w./]*)`")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def prose(path: Path) -> str:
    return BLOCK.sub("", path.read_text())


def anchors(path: Path) -> set[str]:
    """The names that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(path: Path) -> list[str]:
    """Those that lead into the repository."""
    return [link for link in LINK.findall(prose(path)) if "://" not in link]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere_and_paths_and_targets_of_make_exist(document):
    for link in links(document):
        file, _, anchor = link.partition("#")
        target = (document.parent / file).resolve() if file else document
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link
    text = document.read_text()
    for path in PATH.findall(text):
        assert "NAME" in path or (ROOT / path).exists(), path
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE)) <= TARGETS


def test_the_readme_leads_to_every_document():
    reached = set()
    waiting = [README]
    while waiting:
        document = waiting.pop()
        reached.add(document)
        targets = {(document.parent / link.partition("#")[0]).resolve() for link in links(document)}
        waiting += [target for target in targets & set(DOCUMENTS) if target not in reached]
    assert reached == set(DOCUMENTS)


def test_a_change_is_one_line():
    entries = [line for line in CHANGELOG.read_text().partition("## [")[2].splitlines()[1:] if line]
    assert [line for line in entries if not line.startswith(("- ", "## ", "### ")) or len(line) > 160] == []


def test_the_table_of_studies_leads_to_every_study():
    text = STUDIES.read_text()
    table, *studies = re.split(r"^## ", text, flags=re.MULTILINE)
    linked = {link.partition("#")[2] for link in LINK.findall(table) if link.startswith("#")}
    assert linked == {study.partition("\n")[0].lower().replace(" ", "-") for study in studies}


def test_the_groups_of_settings_are_all_described():
    table = [line for line in (ROOT / "conf/README.md").read_text().splitlines() if line.startswith("| `")]
    described = {name for line in table for name in re.findall(r"`(\w+)`", line.split("|")[1])}
    assert described == {path.name for path in (ROOT / "conf").iterdir() if path.is_dir()}


def test_the_extras_are_all_described():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(PROJECT["optional-dependencies"])


def test_the_citation_is_the_readmes_and_the_changelog_knows_this_version():
    citation = OmegaConf.load(ROOT / "CITATION.cff")
    paper = citation["preferred-citation"]
    text = README.read_text()
    authors = " and ".join(f"{one['family-names']}, {one['given-names']}" for one in paper.authors)
    for field, value in {"title": paper.title, "author": authors, "year": paper.year}.items():
        assert re.search(rf"{field} += {re.escape(f'{{{value}}}')}", text)
    assert citation.version == PROJECT["version"]
    assert PROJECT["license"] == f"{citation.license} AND CC-BY-SA-4.0"  # of the weights `fruits`
    assert f"## [{PROJECT['version']}] - {citation['date-released']}" in CHANGELOG.read_text()
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    for key in ("title", "version", "license", "keywords"):
        assert zenodo[key] == citation[key]
    assert zenodo["description"] == citation["abstract"]
    assert zenodo["creators"] == citation["authors"]
    assert zenodo["publication_date"] == str(citation["date-released"])


def test_colab_opens_the_first_notebook_of_the_repository_and_installs_it():
    """The address is a setting; a test of the wheel sees that the badge is not in it."""
    repository = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["completesplat"]["repository"]
    notebook = ROOT / "notebooks/0_quickstart.ipynb"
    for path in (README, notebook):
        (opened,) = re.findall(r"\]\(https://colab\.research\.google\.com/github/([^)]*)\)", path.read_text())
        assert opened == f"{repository}/blob/main/{notebook.relative_to(ROOT).as_posix()}"
    assert re.findall(r"git\+https://github\.com/([\w./-]+)", notebook.read_text()) == [repository]


def test_the_weights_that_the_readme_names_are_in_the_package():
    named = re.findall(r"\]\(completesplat/weights/(\w+)/README\.md\)", README.read_text())
    assert set(named) == set(shipped())


def test_the_matrix_has_each_python_and_system_of_the_classifiers_and_one_row_has_all_tests():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    rows = workflow["jobs"]["test"]["strategy"]["matrix"]["include"]
    versions = re.findall(r"Programming Language :: Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert PROJECT["requires-python"] == f">={versions[0]}"
    systems = ("ubuntu-latest", "macos-latest")
    assert {(row["system"], row["python"]) for row in rows} == {(s, version) for s in systems for version in versions}
    assert sorted(row["command"] for row in rows) == [".ci/run", *["make test"] * (len(rows) - 1)]
    (step,) = [step for step in workflow["jobs"]["test"]["steps"] if "run" in step]
    assert step["run"] == "${{ matrix.command }}"


@pytest.mark.parametrize("path", sorted((ROOT / ".github/workflows").iterdir()), ids=lambda path: path.name)
def test_workflows_may_only_read_the_repository_and_run_githubs_own_actions(path):
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"]["contents"] == "read"
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all(step["uses"].startswith("actions/") for step in steps if "uses" in step)
    commands = "\n".join(step["run"] for step in steps if "run" in step)
    assert set(re.findall(r"^make ([a-z-]+)", commands, re.MULTILINE)) <= TARGETS
