"""The site, in outputs/site: documents, notebooks, a gallery that turns, weights with scores, API (`make site`).

Nothing is written twice: documents are copied with links that lead to pages, scores come from the weights' cards, and
the gallery is what `completesplat predict` writes for the images of `make demo`. Sphinx builds the pages.
"""

import ast
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
PACKAGE, CARDS = ROOT / "completesplat", "completesplat/weights"
API, GALLERY, SITE = (ROOT / "outputs" / name for name in ("api", "gallery", "site"))
REPOSITORY = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["completesplat"]["repository"]
DOCUMENTS = ("*.md", "conf/*.md", "completesplat/**/README.md", "notebooks/*.md", "notebooks/*.ipynb")
BESIDE = ("LICENSE", "completesplat/**/LICENSE.txt", "completesplat/**/*.jpg", "notebooks/*.png")
LINK = re.compile(r"(?<=\]\()(?!#|\w+:)([^)\s#]+)(#[^)\s]*)?(?=\))")
CONTENTS = {
    "Start": ["gallery", "weights", *(f"notebooks/{path.stem}" for path in sorted(ROOT.glob("notebooks/*.ipynb")))],
    "Use": [f"completesplat/{name}/index" for name in ("export", "viewer", "data", "training")] + ["conf/index"],
    "Measure": [f"completesplat/{name}/index" for name in ("evaluation", "evaluation/board", "rasterizers")]
    + ["notebooks/experiments"],
    "Build on it": ["api", "CONTRIBUTING", "SECURITY", "CHANGELOG"],
}
# Notebooks run commands in a shell, which is no Python.
OPTIONS = {
    "project": "completesplat",
    "root_doc": "index",
    "extensions": "myst_nb",
    "html_theme": "furo",
    "html_title": "completesplat",
    "html_copy_source": "0",
    "html_show_copyright": "0",
    "html_static_path": "style",
    "html_css_files": "wide.css",
    "highlight_language": "text",
    "myst_heading_anchors": "4",
    "nb_execution_mode": "off",
    "suppress_warnings": "misc.highlighting_failure",
}
SHOWN = {
    "fruit": ("fruits", "A photograph of an apple that training never saw, by weights for fruit on white."),
    "couch": ("rendered_couches", "A rendered couch that training never saw, by weights for such renders."),
    "toy": ("toy_objects", "A toy of a seed that training never used, by weights for toy objects."),
    "photograph": ("general", "A photograph of a cup of coffee (scikit-image's), by weights for a photo of anything."),
}
SAMPLES = 2
TRY = "try"  # folder of the page that `make try` writes after the site
PLACES = "[scenes that turn](gallery.md), [weights and their scores](weights.md), [API](api.md)"
FIRST = f'<a href="{TRY}/index.html">Try it in your browser</a>, {PLACES}.'
# Commands and tables of scores are wider than furo's text.
STYLE = """
.content { width: 54em }
.sidebar-drawer { width: max(15em, calc(50% - 33em)) }
td:first-child { min-width: 10em }
iframe { width: 100%; height: 26rem; border: 1px solid var(--color-background-border) }
"""
FRAME = '<iframe src="{}" title="{}" loading="lazy"></iframe>'


def page_of(path: Path) -> Path:
    """Return where a file of the repository lies in the site's source; a README is its folder's first page."""
    path = path.relative_to(ROOT)
    return path.with_name("index.md") if path.name == "README.md" else path


def moved(text: str, document: Path, page: Path) -> str:
    """Make a document's links lead to pages, to the API reference, or to the repository's address.

    Args:
        document: where the text comes from.
        page: where it goes, relative to the site's source.
    """
    collected = set(files(DOCUMENTS + BESIDE))

    def target(link: re.Match[str]) -> str:
        path, anchor = (document.parent / link[1]).resolve(), link[2] or ""
        if path in collected:
            return up(page) + page_of(path).as_posix() + anchor
        return f"https://github.com/{REPOSITORY}/blob/main/{path.relative_to(ROOT).as_posix()}{anchor}"

    text = re.sub(
        r"\[([^\]]+)\]\(([^)\s#:]+\.py)\)", lambda link: reference(link[1], document.parent / link[2], page), text
    )
    return LINK.sub(target, text)


def reference(name: str, module: Path, page: Path) -> str:
    """Return a link to a module's page of the API reference, in HTML, because Sphinx does not know these pages."""
    return f'<a href="{up(page)}api/{module.resolve().relative_to(ROOT).with_suffix(".html").as_posix()}">{name}</a>'


def up(page: Path) -> str:
    """Return the way from a page to the top folder."""
    return "../" * (len(page.parts) - 1)


def files(patterns: tuple[str, ...]) -> list[Path]:
    return sorted(path for pattern in patterns for path in ROOT.glob(pattern))


def collect(tree: Path, gallery: Path) -> None:
    """Write the site's source into an empty folder."""
    for path in files(BESIDE):
        write(tree / page_of(path), path.read_bytes())
    for path in files(DOCUMENTS):
        page = page_of(path)
        # Links of notebooks are not changed: these lie in JSON, and none leads into the repository.
        write(
            tree / page, path.read_bytes() if page.suffix == ".ipynb" else moved(path.read_text(), path, page).encode()
        )
    first = tree / "index.md"
    title, badge, text = first.read_text().partition(" [![")  # a badge within a heading is drawn as large as its text
    text = f"{title}\n\n{FIRST} {badge.strip()}{text}"
    write(first, "\n".join([text, *map(contents, CONTENTS, CONTENTS.values())]).encode())
    write(tree / "style/wide.css", STYLE.encode())
    write(tree / "weights.md", weights_page().encode())
    write(tree / "gallery.md", gallery_page(gallery).encode())
    write(tree / "api.md", api_page().encode())


def write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def contents(caption: str, pages: list[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


def weights_page() -> str:
    """Return each card's first paragraph and scores."""
    parts = ["# Weights", "Weights in the package, with the scores of their cards. `weights=auto` chooses among them."]
    cards = files((f"{CARDS}/*/README.md",))
    for card in cards:
        text = moved(card.read_text(), card, Path("weights.md"))
        introduction = re.search(r"^# .*\n\n((?:.+\n)+)", text, re.MULTILINE)
        scores = re.search(r"^## Scores\n(.*?)(?=^## )", text, re.MULTILINE | re.DOTALL)
        parts += [f"## [{card.parent.name}]({page_of(card).as_posix()})", introduction[1], scores[1]]
    return "\n\n".join([*parts, contents("Cards", [page_of(card).with_suffix("").as_posix() for card in cards])])


def gallery_page(gallery: Path) -> str:
    """Return a page with the photo, a sample that turns and the contact sheet of each prediction."""
    parts = [
        "# Gallery",
        "Real outputs: each page below is the one that `completesplat predict` writes for the format `html`. Drag to"
        " turn a scene. What the photo does not show is made up; each sample is another guess.",
    ]
    for name, (weights, caption) in SHOWN.items():
        (photo,) = gallery.glob(f"{name}.*")
        pages = [page.relative_to(gallery.parent).as_posix() for page in sorted((gallery / name).glob("sample_*.html"))]
        command = f"completesplat predict image={photo.name} weights={weights} samples={SAMPLES} 'formats=[html]'"
        parts += [f"## {name.capitalize()}", caption, f"```\n{command}\n```"]
        parts += [FRAME.format(page, f"{name}, sample 0") for page in pages[:1]]
        parts += [" ".join(f'<a href="{page}">Sample {i}, large.</a>' for i, page in enumerate(pages))]
        parts += [f'<img src="gallery/{name}/sheet.png" alt="The photo, then each sample from eight directions">']
    return "\n\n".join(parts) + "\n"


def api_page() -> str:
    """Return a table of the package's parts, with the first line of their docstrings."""
    rows = ["# API", "", "From the docstrings, by pdoc.", "", "| module | what it holds |", "|---|---|"]
    for path in [PACKAGE / "__init__.py", *files(("completesplat/*/__init__.py", "completesplat/[a-z]*.py"))]:
        summary = ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]
        module = path.parent if path.name == "__init__.py" else path.with_suffix("")
        name = ".".join(module.relative_to(ROOT).parts)
        rows.append(f"| {reference(name, module, Path('api.md'))} | {summary} |")
    return "\n".join(rows)


def predict(gallery: Path) -> None:
    """Write what the gallery shows and is not there yet; without Node.js, without the pages that turn."""
    import skimage

    def run(*command: str) -> None:
        subprocess.run([sys.executable, "-m", "completesplat", *command], check=True, cwd=ROOT)

    gallery.mkdir(parents=True, exist_ok=True)
    toys = gallery / "toys"
    if not (toys / "run.json").exists():
        run("data", "toy", "kind=objects", "scenes=1", "seed=1000", f"out={toys}")
    photos = [ROOT / CARDS / name / "held_out.jpg" for name in ("fruits", "rendered_couches")]
    photos += [*toys.glob("*/*/images/frame000001.jpg"), Path(skimage.__file__).parent / "data/coffee.png"]
    formats = "[html]" if shutil.which("npx") or shutil.which("splat-transform") else "[]"
    for (name, (weights, _)), photo in zip(SHOWN.items(), photos, strict=True):
        if not (gallery / name / "scene.json").exists():
            copy = shutil.copy(photo, gallery / f"{name}{photo.suffix}")
            options = [f"samples={SAMPLES}", f"formats={formats}", "video=[]", f"out={gallery}"]
            run("predict", f"image={copy}", f"weights={weights}", *options)


def build(site: Path, gallery: Path, api: Path) -> None:
    """Build the site anew; Sphinx's warnings are errors."""
    shutil.rmtree(site, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "source"
        collect(tree, gallery)
        options = [text for option in OPTIONS.items() for text in ("-D", "=".join(option))]
        command = [
            sys.executable,
            "-m",
            "sphinx",
            "-q",
            "-C",
            "-W",
            "--keep-going",
            "-d",
            f"{folder}/doctrees",
            *options,
        ]
        subprocess.run([*command, str(tree), str(site)], check=True, cwd=folder)
    for name in SHOWN:
        shutil.copytree(gallery / name, site / "gallery" / name)
    shutil.copytree(api, site / "api")
    (site / ".nojekyll").touch()  # GitHub Pages would leave out folders that begin with an underscore


class Page(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value for name, value in attrs if name in ("href", "src") and value]
        self.anchors |= {value for name, value in attrs if name in ("id", "name") and value}


def dead_links(site: Path) -> list[str]:
    """Return the links, images and anchors within the site that lead nowhere, each with its page."""
    site = site.resolve()
    paths = [path for path in site.rglob("*.html") if path.relative_to(site).parts[0] != "gallery"]
    pages = {path: Page(path) for path in paths}
    dead = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            missing = parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors
            made_later = target == site / TRY / "index.html"
            if missing or not (target.is_file() or made_later):
                dead.append(f"{path.relative_to(site).as_posix()}: {link}")
    return dead


if __name__ == "__main__":
    predict(GALLERY)
    build(SITE, GALLERY, API)
    if dead := dead_links(SITE):
        sys.exit("links that lead nowhere:\n" + "\n".join(dead))
    print(SITE / "index.html")
