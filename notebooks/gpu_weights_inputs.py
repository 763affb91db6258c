"""What `gpu_weights.py` needs, packed small into one folder: `make gpu-weights-inputs`.

python notebooks/gpu_weights_inputs.py INPUTS START SCANS [MORE ...]
python notebooks/gpu_weights_inputs.py INPUTS --small

START is a folder of weights to go on from. SCANS is a folder of captures with exact masks and a `splits.json`, of which
training's and validation's are packed, never the test's. All captures below the folders MORE are training's. Images
keep their size and become WebP. `--small` packs the package's `general` and a few toys, for a rehearsal.
"""

import argparse
import io
import json
import runpy
import shutil
import tarfile
import tempfile
from pathlib import Path

from PIL import Image

from completesplat.data.toy import write_objects
from completesplat.files import write_json

QUALITY = 85
HERE = Path(__file__).parent
GENERAL = HERE.parent / "completesplat/weights/general"
SMALL_SIZE = 32
FRAMES = 10  # of a toy: stage 2 compares nine with the first


def add(packed: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add a file to an archive."""
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    packed.addfile(entry, io.BytesIO(content))


def add_capture(packed: tarfile.TarFile, name: str, folder: Path) -> None:
    """Add a capture's `transforms.json`, images, masks and points to an archive."""
    capture = json.loads((folder / "transforms.json").read_text())
    for frame in capture["frames"]:
        image = io.BytesIO()
        Image.open(folder / frame["file_path"]).convert("RGB").save(image, "WEBP", quality=QUALITY, method=6)
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(".webp"))
        add(packed, f"{name}/{frame['file_path']}", image.getvalue())
        add(packed, f"{name}/{frame['mask_path']}", (folder / frame["mask_path"]).read_bytes())
    if "ply_file_path" in capture:
        add(packed, f"{name}/{capture['ply_file_path']}", (folder / capture["ply_file_path"]).read_bytes())
    add(packed, f"{name}/transforms.json", json.dumps(capture).encode())


def pack(inputs: Path, start: Path, scans: Path, more: list[Path]) -> None:
    """Write weights, captures and their splits into a folder."""
    inputs.mkdir(parents=True)
    for file in ("config.json", "model.safetensors"):
        shutil.copy(start / file, inputs)
    splits = json.loads((scans / "splits.json").read_text())
    names = {"scans": splits["train"], "val": splits["val"], "more": []}
    with tarfile.open(inputs / "captures.tar.gz", "w:gz") as packed:
        for name in names["scans"] + names["val"]:
            add_capture(packed, name, scans / name)
        for folder in more:
            for path in sorted(folder.rglob("transforms.json")):
                name = f"{folder.name}_{path.parent.relative_to(folder)}".replace("/", "_")
                names["more"].append(name)
                add_capture(packed, name, path.parent)
    write_json(inputs / "captures.json", names)


def pack_small(inputs: Path) -> None:
    """Pack the package's `general` and a few toys."""
    with tempfile.TemporaryDirectory() as folder:
        toys, captures = Path(folder, "toys"), Path(folder, "captures")
        write_objects(toys, scenes=6, frames=FRAMES, size=SMALL_SIZE, seed=0, workers=1, progress=False)
        settings = ["data=toy_objects", f"data.root={toys}", f"data.image_size={SMALL_SIZE}"]
        depths = ["data.depth_before=1", "data.depth_after=3"]
        write_captures = runpy.run_path(str(HERE / "as_captures.py"))["main"]
        write_captures(captures, "toy_", str(FRAMES), "train,val,test", *settings, *depths)
        names = sorted(path.name for path in captures.iterdir())
        write_json(captures / "splits.json", {"train": names[2:], "val": names[:2], "test": []})
        pack(inputs, GENERAL, captures, [])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", type=Path)
    parser.add_argument("start", type=Path, nargs="?")
    parser.add_argument("scans", type=Path, nargs="?")
    parser.add_argument("more", type=Path, nargs="*")
    parser.add_argument("--small", action="store_true")
    options = parser.parse_args()
    if options.small:
        pack_small(options.inputs)
    elif options.scans is None:
        parser.error("START and SCANS are needed: make gpu-weights-inputs START=WEIGHTS SCANS=FOLDER")
    else:
        pack(options.inputs, options.start, options.scans, options.more)
    files = sorted(options.inputs.iterdir())
    print(f"{options.inputs}: {sum(file.stat().st_size for file in files) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
