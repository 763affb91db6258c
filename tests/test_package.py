"""What `import completesplat` offers."""

import pytest
from support import python

import completesplat
from completesplat.export.ply import read_ply, write_ply
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat


def test_the_package_offers_the_model_and_its_scenes():
    assert completesplat.CompleteSplat is CompleteSplat
    assert completesplat.Gaussians is Gaussians
    assert (completesplat.read_ply, completesplat.write_ply) == (read_ply, write_ply)
    assert {"CompleteSplat", "Gaussians", "read_ply", "write_ply"} <= set(dir(completesplat))
    with pytest.raises(AttributeError, match="has no attribute 'Gaussian'"):
        completesplat.Gaussian  # noqa: B018


def test_the_package_itself_does_not_wait_for_torch():
    code = "import sys, completesplat; print('torch' in sys.modules)"
    assert python(code) == "False\n"
