"""What the documents say of the repository is so: links, paths, targets of make, groups, versions, authors."""

import json
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from written_commands import BLOCK, CHANGELOG, DOCUMENTS, README, ROOT, STUDIES

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
    reached, waiting = set(), [README]
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
    paper, text = citation["preferred-citation"], README.read_text()
    authors = " and ".join(f"{one['family-names']}, {one['given-names']}" for one in paper.authors)
    for field, value in {"title": paper.title, "author": authors, "year": paper.year}.items():
        assert re.search(rf"{field} += {re.escape(f'{{{value}}}')}", text)
    assert citation.version == PROJECT["version"]
    assert PROJECT["license"] == f"{citation.license} AND CC-BY-SA-4.0"  # of the weights `fruits`
    assert f"## [{PROJECT['version']}] - {citation['date-released']}" in CHANGELOG.read_text()
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    same = {"title": "title", "description": "abstract", "version": "version", "license": "license"}
    same |= {"keywords": "keywords", "creators": "authors"}
    assert {key: zenodo[key] for key in same} == {key: citation[name] for key, name in same.items()}
    assert zenodo["publication_date"] == str(citation["date-released"])


def test_colab_opens_the_first_notebook_of_the_repository_and_installs_it():
    """The address is a setting; a test of the wheel sees that the badge is not in it."""
    repository = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["completesplat"]["repository"]
    notebook = ROOT / "notebooks/0_quickstart.ipynb"
    for path in (README, notebook):
        (opened,) = re.findall(r"\]\(https://colab\.research\.google\.com/github/([^)]*)\)", path.read_text())
        assert opened == f"{repository}/blob/main/{notebook.relative_to(ROOT).as_posix()}"
    assert re.findall(r"git\+https://github\.com/([\w./-]+)", notebook.read_text()) == [repository]


def test_the_hooks_are_the_checks_of_make_and_the_workflow_runs_what_must_hold():
    hooks = [hook for repo in OmegaConf.load(ROOT / ".pre-commit-config.yaml").repos for hook in repo.hooks]
    recipe = subprocess.run(["make", "--dry-run", "check"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert all(hook.language == "system" for hook in hooks)
    assert {hook.entry.removesuffix(" --force-exclude") for hook in hooks} <= set(recipe.splitlines())
    assert "- run: .ci/run\n" in (ROOT / ".github/workflows/ci.yml").read_text()


@pytest.mark.parametrize("path", sorted((ROOT / ".github/workflows").iterdir()), ids=lambda path: path.name)
def test_workflows_use_githubs_own_actions_the_oldest_python_and_known_targets_of_make(path):
    text = path.read_text()
    assert re.findall(r"uses: \S+", text) == re.findall(r"uses: actions/[\w-]+@v\d+(?=\n)", text)
    oldest = PROJECT["requires-python"].removeprefix(">=")
    assert {*re.findall(r'python-version: "(.*)"', text)} <= {oldest}
    assert {*re.findall(r"run: make ([a-z-]+)", text)} <= TARGETS
    assert yaml.safe_load(text)["permissions"]["contents"] == "read"
