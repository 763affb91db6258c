"""Runs and weights between others of one training line (experiments.md, "Things all the way round").

python notebooks/averages.py RUN OUT SHARE OTHER.ckpt     # OUT: a run like RUN, with SHARE of RUN and the rest of OTHER
python notebooks/averages.py OUT SHARE=WEIGHTS ...        # OUT: weights (a folder), an average of these

All tensors are averaged (Wortsman et al., CVPR 2022, "Robust fine-tuning of zero-shot models"). Optimizer, steps and
config of a run are RUN's. The camera of a typical photo and the facts of training (`config.json`) of weights are those
of the first folder; the rest of `config.json` is that of the last.
"""

import json
import shutil
import sys
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

CAMERA = {"depth_range", "fov_degrees", "up"}
LAST = Path("checkpoints/last.ckpt")


def average(shares, states):
    """Return the weighted sum of tensors by name, in the types of the first; those of the camera are the first's."""
    mixed = {}
    for name, first in states[0].items():
        if name in CAMERA:
            mixed[name] = first
            continue
        total = sum(share * state[name].float() for share, state in zip(shares, states, strict=True))
        mixed[name] = total.to(first.dtype)
    return mixed


def average_run(run, out, share, other):
    """Write a run whose last checkpoint has the average of two."""
    shutil.copytree(run, out, ignore=shutil.ignore_patterns("checkpoints", "images", "weights"))
    checkpoint = torch.load(Path(run) / LAST, map_location="cpu", weights_only=True)
    others = torch.load(other, map_location="cpu", weights_only=True)["state_dict"]
    checkpoint["state_dict"] = average([float(share), 1 - float(share)], [checkpoint["state_dict"], others])
    (Path(out) / LAST).parent.mkdir()
    torch.save(checkpoint, Path(out) / LAST)


def average_weights(out, *words):
    """Write the average of weights as the words of the command say."""
    shares, folders = zip(*(word.split("=", 1) for word in words), strict=True)
    states = [load_file(f"{folder}/model.safetensors") for folder in folders]
    Path(out).mkdir(parents=True, exist_ok=True)
    save_file(average([float(share) for share in shares], states), f"{out}/model.safetensors")
    first, last = (json.loads(Path(folder, "config.json").read_text()) for folder in (folders[0], folders[-1]))
    Path(out, "config.json").write_text(json.dumps({**last, "training": first["training"]}, indent=2) + "\n")


if __name__ == "__main__":
    (average_weights if "=" in sys.argv[2] else average_run)(*sys.argv[1:])
