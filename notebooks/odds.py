"""Measure how the features of photos of one kind tell them from photos of other things on the same background.

python notebooks/odds.py WEIGHTS KIND OTHERS [seed=0]

WEIGHTS is a folder with `config.json`, into whose `training` the result goes (`log_odds`, `feature_odds`: the logarithm
of the odds is `log_odds` + features * `feature_odds`). KIND and OTHERS are folders with images at any depth, of which
those in folders `masks` are left out. A logistic regression counts both kinds alike. One image in five is held out, by
the folder that it lies in, and the shares of them that are told rightly are printed.
"""

import json
import random
import sys
from collections import defaultdict
from pathlib import Path

import torch

from completesplat.files import write_text
from completesplat.photo.features import image_features
from completesplat.photo.reading import Framing, read_square
from completesplat.weights import CONFIG_FILE, write_sums

IMAGES = 6  # at most, of each folder
HELD_OUT = 5  # one folder in so many
DECAY = 1e-3  # weight of the squares of the standardised coefficients


def features_of(folder, size, seed):
    """Return the features of images below a folder: those to fit, and those that are held out."""
    by_folder = defaultdict(list)
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".jpg", ".png") and path.parent.name != "masks":
            by_folder[path.parent].append(path)
    places = list(by_folder)
    random.Random(seed).shuffle(places)
    parts = ([], [])
    for number, place in enumerate(places):
        images = by_folder[place]
        for path in images[:: -(-len(images) // IMAGES)]:
            image = read_square(path, Framing(size), crop="center").image
            parts[number % HELD_OUT == 0].append(image_features(image).double())
    return tuple(torch.stack(part) for part in parts)


def fitted(kind, others):
    """Return the coefficients of the features and the constant of the logarithm of the odds."""
    mean = torch.cat([kind, others]).mean(0)
    deviation = torch.cat([kind, others]).std(0)
    values = torch.zeros(len(mean) + 1, dtype=torch.double, requires_grad=True)
    optimizer = torch.optim.LBFGS([values], max_iter=300, line_search_fn="strong_wolfe")

    def logarithms(features):
        return (features - mean) / deviation @ values[:-1] + values[-1]

    def loss():
        optimizer.zero_grad()
        missed = torch.nn.functional.softplus(-logarithms(kind)).mean()
        taken = torch.nn.functional.softplus(logarithms(others)).mean()
        total = missed + taken + DECAY * values[:-1].square().sum()
        total.backward()
        return total

    optimizer.step(loss)
    coefficients = (values[:-1] / deviation).detach()
    return coefficients, (values[-1].detach() - coefficients @ mean)


def main():
    """Fit, print the shares of held-out images that are told rightly, and write the config and its checksum."""
    words = dict(word.split("=") for word in sys.argv[4:])
    folder, kind, others = map(Path, sys.argv[1:4])
    config = json.loads((folder / CONFIG_FILE).read_text())
    seed = int(words.get("seed", 0))
    of_kind, held_out = features_of(kind, config["image_size"], seed)
    of_others, held_out_others = features_of(others, config["image_size"], seed)
    coefficients, constant = fitted(of_kind, of_others)
    right = ((held_out @ coefficients + constant) > 0).double().mean()
    right_others = ((held_out_others @ coefficients + constant) < 0).double().mean()
    print(f"held out: {right:.1%} of {len(held_out)} of the kind, {right_others:.1%} of {len(held_out_others)} others")
    config["training"]["log_odds"] = round(constant.item(), 4)
    config["training"]["feature_odds"] = [round(value, 4) for value in coefficients.tolist()]
    write_text(folder / CONFIG_FILE, json.dumps(config, indent=2) + "\n")
    write_sums(folder)


if __name__ == "__main__":
    main()
