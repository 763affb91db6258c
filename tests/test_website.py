"""The site's source: nothing is left out or written twice, and links lead somewhere (`make site` builds the pages)."""

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
from written_commands import CARDS, DOCUMENTS, ROOT

WEBSITE = SimpleNamespace(**runpy.run_path(str(ROOT / "notebooks/website.py")))


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    """The source, with a gallery of empty files."""
    folder = tmp_path_factory.mktemp("site")
    for name in WEBSITE.SHOWN:
        (folder / "gallery" / name).mkdir(parents=True)
        for file in (f"{name}.jpg", f"{name}/sample_00.html", f"{name}/sample_01.html"):
            (folder / "gallery" / file).touch()
    WEBSITE.collect(folder / "source", folder / "gallery")
    return folder / "source"


@pytest.mark.parametrize(
    ("document", "link", "moved"),
    [
        ("README.md", "[a](conf/README.md#extend)", "[a](conf/index.md#extend)"),
        ("conf/README.md", "[a](../README.md)", "[a](../index.md)"),
        ("README.md", "![a](notebooks/fruits.png)", "![a](notebooks/fruits.png)"),
        ("conf/README.md", "[a](../completesplat/cli.py)", '<a href="../api/completesplat/cli.html">a</a>'),
        ("conf/README.md", "[a](fit.yaml)", f"[a](https://github.com/{WEBSITE.REPOSITORY}/blob/main/conf/fit.yaml)"),
        ("README.md", "[a](#cite), [b](https://example.org/README.md)", "[a](#cite), [b](https://example.org/README.md)"),
    ],
)  # fmt: skip
def test_links_lead_to_pages_to_the_reference_or_to_the_repository(document, link, moved):
    path = ROOT / document
    assert WEBSITE.moved(link, path, WEBSITE.page_of(path)) == moved


def test_the_contents_have_every_document_and_notebook_once(tree):
    files = [path.relative_to(tree) for path in tree.rglob("*") if path.suffix in (".md", ".ipynb")]
    pages = {file.with_suffix("").as_posix() for file in files}
    listed = [page for part in WEBSITE.CONTENTS.values() for page in part]
    listed += [WEBSITE.page_of(card).with_suffix("").as_posix() for card in CARDS]
    assert sorted(listed) == sorted(pages - {"index"})
    notebooks = (ROOT / "notebooks").glob("*.ipynb")
    assert {WEBSITE.page_of(path).with_suffix("").as_posix() for path in [*DOCUMENTS, *notebooks]} <= pages


def test_relative_links_of_the_source_lead_to_its_files(tree):
    for page in tree.rglob("*.md"):
        for link in WEBSITE.LINK.finditer(page.read_text()):
            assert (page.parent / link[1]).is_file(), f"{page.relative_to(tree)}: {link[0]}"


def test_the_page_of_weights_has_the_scores_of_each_card_and_the_gallery_each_sample(tree):
    weights = (tree / "weights.md").read_text()
    gallery = (tree / "gallery.md").read_text()
    for card in CARDS:
        rows = re.findall(r"^\|.*\|$", card.read_text().split("## Scores")[1].split("## ")[0], re.MULTILINE)
        assert len(rows) > 3
        assert all(row in weights for row in rows)
    assert gallery.index("## Fruit") < gallery.index("## Couch")
    assert set(re.findall(r'src="(\S+html)"', gallery)) == {f"gallery/{name}/sample_00.html" for name in WEBSITE.SHOWN}
    assert all(f'href="gallery/{name}/sample_01.html"' in gallery for name in WEBSITE.SHOWN)


def test_links_that_lead_nowhere_are_found(tmp_path):
    (tmp_path / "part").mkdir()
    (tmp_path / "part/index.html").write_text('<h1 id="there">')
    good = '<a href="part/#there"></a><a href="https://example.org/x"></a><a href="#"></a><img src="data:,">'
    (tmp_path / "index.html").write_text(good)
    assert WEBSITE.dead_links(tmp_path) == []
    (tmp_path / "index.html").write_text(good + '<a href="gone.html"></a><a href="part/#gone"></a><img src="gone.png">')
    assert WEBSITE.dead_links(tmp_path) == [f"index.html: {link}" for link in ("gone.html", "part/#gone", "gone.png")]
