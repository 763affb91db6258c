"""Hidden modes of renders: read from files of every paint, which toy objects with every patch stand for here."""

import gzip
import json
import shutil
from pathlib import Path

import pytest

from completesplat.data.rendered.drawing import PAINTS
from completesplat.data.rendered.module import RenderedDataModule
from completesplat.data.toy.object_scene import PATCH_COLORS
from completesplat.errors import CompleteSplatError, DataError


@pytest.fixture
def root(toy_root: Path, tmp_path: Path) -> Path:
    """Root of toy objects in the form of renders."""
    category = shutil.copytree(toy_root / "toy_objects", tmp_path / "root/rendered")
    (category / "rendered.json").write_text(json.dumps({"hidden": "modes"}))
    for annotations in category.glob("*.jgz"):
        annotations.write_bytes(
            gzip.compress(gzip.decompress(annotations.read_bytes()).replace(b"toy_objects", b"rendered"))
        )
    for record in category.glob("*_*/toy.json"):
        hidden = json.loads(record.read_text())["hidden"]
        record.with_name("object.json").write_text(json.dumps({"hidden": hidden}))
        record.unlink()
    return category.parent


def test_modes_are_the_images_of_every_paint_and_the_true_one_is_what_the_data_module_yields(root: Path) -> None:
    data = RenderedDataModule(str(root), image_size=32, test_fraction=1.0)
    data.setup("test")
    painted = next(root.glob("rendered/*/red")).parent.name  # the toys' test scene
    scene = data.hidden_modes(2, 3)[data.store("test").names.index(painted)]
    assert list(PAINTS) == list(PATCH_COLORS)
    assert scene.modes == tuple(PAINTS)
    assert scene.probabilities.tolist() == pytest.approx([0.4, 0.3, 0.2, 0.1])
    told = json.loads((root / "rendered" / painted / "object.json").read_text())
    assert scene.modes[scene.true_mode] == told["hidden"]
    errors = (scene.truths - scene.scene.targets.images[0, list(scene.views)]).abs().amax((1, 2, 3, 4))
    assert errors[scene.true_mode] == 0
    assert sorted(errors > 0.1) == [False, True, True, True]


def test_what_has_no_modes_is_refused(root: Path) -> None:
    data = RenderedDataModule(str(root), image_size=32)
    (root / "rendered/rendered.json").write_text('{"hidden": "back"}')
    with pytest.raises(CompleteSplatError, match="rendered with hidden=back; hidden modes need hidden=modes"):
        data.hidden_modes(2, 3)
    (root / "rendered/rendered.json").unlink()
    with pytest.raises(DataError, match="as they were rendered, not prepared"):
        data.hidden_modes(2, 3)
