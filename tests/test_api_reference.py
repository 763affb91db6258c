"""The API reference that `make docs` makes."""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

FOR_BLENDER = [f"!completesplat.data.rendered._scene_{name}" for name in ("script", "meshes")]
PDOC = [sys.executable, "-m", "pdoc", "--docformat", "google", "completesplat", *FOR_BLENDER, "--output-directory"]


@pytest.mark.slow
def test_every_module_has_a_page_whose_links_lead_somewhere(tmp_path: Path) -> None:
    made = subprocess.run([*PDOC, tmp_path], capture_output=True, text=True)
    # Before Python 3.12 a TypedDict does not tell which one it comes from.
    message = [line for line in made.stderr.splitlines() if not line.startswith("Warn: Cannot determine where")]
    assert (made.returncode, message) == (0, [])
    pages = {path.resolve(): path.read_text() for path in tmp_path.rglob("*.html")}
    model = pages[(tmp_path / "completesplat/generator.html").resolve()]
    assert 'id="CompleteSplat.from_pretrained"' in model
    dead = []
    links = 0
    for path, text in pages.items():
        for link in re.findall(r'href="([^"]+)"', text):
            if not re.match(r"[a-z]+:|\$|\[", link):  # a script fills in the rest; an expression in a source
                file, _, name = unquote(link).partition("#")
                target = (path.parent / file).resolve() if file else path
                there = target in pages and (not name or f'id="{name}"' in pages[target])
                links += 1
                dead += [] if there else [(path.name, link)]
    assert dead == []
    assert links > 1000
