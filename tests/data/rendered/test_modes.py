"""Hidden modes of renders: read from files of every paint, which toy objects with every patch stand for here."""

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from completesplat.data.images.files import save_jpeg
from completesplat.data.rendered.drawing import PAINTS
from completesplat.data.rendered.module import RenderedDataModule
from completesplat.data.rendered.rendering import in_mode
from completesplat.data.toy.modes import unseen
from completesplat.data.toy.object_scene import PATCH_COLORS, render_frame
from completesplat.data.toy.raytracing import WHITE
from completesplat.data.toy.writing import draw
from completesplat.errors import CompleteSplatError, DataError


@pytest.fixture(scope="module")
def root(toy_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of toy objects in the form of renders."""
    root = tmp_path_factory.mktemp("modes")
    category = shutil.copytree(toy_root / "toy_objects", root / "rendered")
    described = json.loads((category / "toy.json").read_text())
    (category / "rendered.json").write_text(json.dumps({"hidden": "modes"}))
    for annotations in category.glob("*.jgz"):
        annotations.write_bytes(
            gzip.compress(gzip.decompress(annotations.read_bytes()).replace(b"toy_objects", b"rendered"))
        )
    for folder in category.glob("*_*/"):
        if not (folder / "toy.json").is_file():
            continue
        scene = draw(
            "toy_objects", described["seed"], int(folder.name.split("_")[0]), described["frames"], np.array(WHITE)
        )
        (folder / "object.json").write_text(json.dumps({"hidden": scene.patch_color}))
        for mode, color in PATCH_COLORS.items():
            (folder / mode).mkdir()
            painted = replace(scene, patch=scene.patch._replace(color=np.array(color)))
            for number, image in enumerate(sorted((folder / "images").iterdir())):
                save_jpeg(render_frame(painted, number, described["size"])[0], in_mode(image, mode))
    return root


def modes_of(root: Path, **settings):
    data = RenderedDataModule(str(root), image_size=32, **settings)
    data.setup("test")
    return data.hidden_modes(2, 3), data


def test_modes_are_the_images_of_every_paint_and_the_true_one_is_what_the_data_module_yields(root):
    scenes, data = modes_of(root)
    scene, name = scenes[0], data.store("test").names[0]
    assert list(PAINTS) == list(PATCH_COLORS)
    assert scene.modes == tuple(PAINTS)
    assert scene.probabilities.tolist() == pytest.approx([0.4, 0.3, 0.2, 0.1])
    told = json.loads((root / "rendered" / name / "object.json").read_text())
    assert scene.modes[scene.true_mode] == told["hidden"]
    stored = scene.scene.targets.images[0, list(scene.views)]
    errors = (scene.truths - stored).abs().amax((1, 2, 3, 4))
    assert errors[scene.true_mode] == 0
    assert sorted(errors > 0.1) == [False, True, True, True]


def test_the_region_is_what_no_pixel_of_the_reference_shows(root, toy_root):
    scenes, data = modes_of(root)
    scene, name = scenes[0], data.store("test").names[0]
    spread = scene.truths.amax(0) - scene.truths.amin(0)
    assert torch.equal(scene.region, (spread > 0.1).any(1))
    assert scene.region.float().mean((1, 2)).min() > 0.005
    # But for pixels at its edge, which are many at this size.
    assert scene.unseen[list(scene.views)][scene.region].float().mean() > 0.75
    # Depths of files tell the same as rays.
    described = json.loads((toy_root / "toy_objects/toy.json").read_text())
    toy = draw("toy_objects", described["seed"], int(name.split("_")[0]), described["frames"], np.array(WHITE))
    sequence = data.source("test").read(name)
    views = [
        view
        for view in range(len(sequence.frames))
        if any(torch.equal(sequence.read(view).image.float() / 255, image) for image in scene.scene.targets.images[0])
    ]
    rays = torch.stack([unseen(toy, sequence.frames[0], sequence.frames[view], 32) for view in views])
    assert (rays == scene.unseen).float().mean() > 0.9


def test_versions_share_the_reference(root):
    versions = modes_of(root)[0].versions(0)
    assert (versions.reference.images == versions.reference.images[:1]).all()
    assert (versions.targets.images != versions.targets.images[:1]).flatten(1).any(1).tolist() == [
        False,
        True,
        True,
        True,
    ]


def test_what_has_no_modes_is_refused(root, tmp_path):
    copied = shutil.copytree(root, tmp_path / "copied")
    name = modes_of(copied)[1].store("test").names[0]
    folder = copied / "rendered" / name
    first, second = sorted((folder / "red").iterdir())[:2]
    shutil.copy(second, first)
    with pytest.raises(DataError, match=f"{name}: the reference view tells the paint of the back"):
        modes_of(copied)[0][0]
    first.unlink()
    with pytest.raises(DataError, match=r"red/frame000001\.jpg"):
        modes_of(copied)[0][0]
    (copied / "rendered/rendered.json").write_text('{"hidden": "back"}')
    with pytest.raises(CompleteSplatError, match="rendered with hidden=back; hidden modes need hidden=modes"):
        modes_of(copied)
    (copied / "rendered/rendered.json").unlink()
    with pytest.raises(DataError, match="as they were rendered, not prepared"):
        modes_of(copied)
