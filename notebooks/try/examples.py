"""Example photos of the page: `python notebooks/try/examples.py FOLDER`.

They are photos of scikit-image that its documentation places under CC0, and photos that the weights in the package have
not seen in training.
"""

import sys
from pathlib import Path

import skimage
from PIL import Image

import completesplat

SIDE = 512  # pixels, at most
PACKAGE = Path(completesplat.__file__).parent
PHOTOS = {
    "1_coffee": Path(skimage.__file__).parent / "data/coffee.png",
    "2_cat": Path(skimage.__file__).parent / "data/chelsea.png",
    "3_apple": PACKAGE / "weights/fruits/held_out.jpg",
    "4_couch": PACKAGE / "weights/rendered_couches/held_out.jpg",
}


def main() -> None:
    """Write the photos as small JPEGs."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in PHOTOS.items():
        photo = Image.open(path).convert("RGB")
        photo.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
        photo.save(folder / f"{name}.jpg", quality=88)


if __name__ == "__main__":
    main()
