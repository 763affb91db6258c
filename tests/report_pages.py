"""A folder with results of every kind that `completesplat report html` shows, made without training."""

import json
from html.parser import HTMLParser
from pathlib import Path

import torch
from PIL import Image

from completesplat.export.video import write_video

EMPTY = {"img", "meta", "link", "br"}  # elements that have no end tag
HOSTILE = '<img src=x onerror=alert(1)> & "quoted"'
FRAMES, SAMPLES = 12, 3
PROTOCOL = {"data_set": "toy_objects", "resolution": 64, "scenes": 2, "method": HOSTILE}


def grey(sample: int, frame: int) -> float:
    """Return the value of all pixels of a frame of a sample's video."""
    return (frame + 1) / (FRAMES + 1) * (1 - 0.2 * sample)


def write_results(root: Path) -> None:
    """A run with scores and images, a benchmark, a report, and a prediction; the first has a hostile name."""
    run = root / HOSTILE
    _write(run / "run.json", {"command": ["completesplat fit", "a=b c"], "commit": "c0ffee", "started": "2026-11-21"})
    _write(run / "metrics.json", {"protocol": PROTOCOL, "model": {"full": {"novel": {"psnr": 21.125}}}})
    (run / "config.yaml").write_text(f"seed: 0 # {HOSTILE}\n")
    for step in range(5):
        image(run / f"images/step_00000{step}.png", 40 * step)
    modes = {"coverage": 0.875, "total_variation": 0.5, "sharpness": 1.0, "rejected": 0.25, "scenes": 2, "samples": 4}
    _write(root / "modes/hidden_modes.json", {"model": modes})
    _write(root / "modes/protocol.json", PROTOCOL)
    image(root / "modes/hidden_modes.png", 200, (2400, 60))
    _write(root / "controls/controls.json", {"rows": [{"sampler": "ddim", "steps": 50, "psnr": 17.25, "more": {}}]})
    settings = {"image": HOSTILE, "seed": 7, "skip_weight": 0.5, "steps": 20}
    _write(root / "predictions/run.json", {"command": ["completesplat predict", "image=x.jpg"]})
    _write(root / "predictions/x/scene.json", {"settings": settings})
    image(root / "predictions/x/sheet.png", 90)
    for sample in range(SAMPLES):
        levels = torch.tensor([grey(sample, frame) for frame in range(FRAMES)])
        write_video(root / f"predictions/x/orbit_{sample:02}.mp4", levels[:, None, None, None].expand(-1, 3, 32, 32))


def image(path: Path, level: int, size: tuple[int, int] = (60, 40)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (level, level, level)).save(path)


def _write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


class Page(HTMLParser):
    """A page as a browser's parser sees it: elements with their attributes, text without that of script and style."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data

    def all(self, tag: str, **attributes: str) -> list[dict[str, str | None]]:
        """The attributes of all elements of a kind; `class_` for `class`."""
        wanted = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items()}
        return [present for name, present in self.elements if name == tag and wanted.items() <= present.items()]
