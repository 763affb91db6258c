"""Fixtures that several folders of tests use."""

from pathlib import Path

import pytest

from completesplat.data.toy import write_objects


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a CO3D tree with the category `toy_objects`: 4 sequences (2 train, 1 val, 1 test), 4 frames, 32 px."""
    root = tmp_path_factory.mktemp("toy")
    write_objects(root, scenes=4, frames=4, size=32, seed=0, workers=1, progress=False)
    return root
