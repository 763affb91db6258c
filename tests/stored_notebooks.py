"""Runs the notebooks from top to bottom and stores them with their outputs: `make notebooks`.

A stored notebook has the hash of the code that it ran, for `test_notebooks.py`, and images that are small: JPEG, at
most 1200 pixels wide.
"""

import base64
import hashlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
HASH = "sha256_of_the_code"
WIDEST, QUALITY = 1200, 88

Notebook = dict[str, Any]


def code_cells(notebook: Notebook) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def hash_of(notebook: Notebook) -> str:
    """Return the hash of all code, in order."""
    return hashlib.sha256("\0".join("".join(cell["source"]) for cell in code_cells(notebook)).encode()).hexdigest()


def jpeg(content: str) -> str:
    """Encode an image in base64 as JPEG."""
    image = Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB")
    image.thumbnail((WIDEST, image.height))
    image.save(buffer := io.BytesIO(), "JPEG", quality=QUALITY)
    return base64.b64encode(buffer.getvalue()).decode()


def slimmed(notebook: Notebook) -> Notebook:
    """Return a notebook with small images, each stream in one piece, without progress bars, and with its hash."""
    for cell in code_cells(notebook):
        outputs: list[dict[str, Any]] = []
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                data["image/jpeg"] = jpeg("".join(data.pop("image/png")))
            if outputs and output["output_type"] == "stream" and outputs[-1].get("name") == output["name"]:
                outputs[-1]["text"] += output["text"]
            elif output["output_type"] != "display_data" or "image/jpeg" in data:
                outputs.append(output)
        cell["outputs"] = outputs
    notebook["metadata"]["language_info"] = {"name": "python"}
    notebook["metadata"]["completesplat"] = {HASH: hash_of(notebook)}
    return notebook


def run(path: Path) -> None:
    """`subprocess.CalledProcessError`: a cell fails; the notebook then has no hash of what it is."""
    # Warnings name this machine's folders. What is no terminal is as wide as `COLUMNS`.
    environment = os.environ | {"PYTHONWARNINGS": "ignore", "COLUMNS": "140"}
    command = [sys.executable, "-m", "jupyter", "execute", "--inplace", path]
    subprocess.run(command, env=environment, check=True)
    notebook = slimmed(json.loads(path.read_text()))
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n")


if __name__ == "__main__":
    for notebook in [Path(name) for name in sys.argv[1:]] or NOTEBOOKS:
        run(notebook)
