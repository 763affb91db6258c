import pytest
from pretrained_vaes import random_vae


@pytest.fixture(scope="module")
def vae():
    return random_vae()


@pytest.fixture
def folder(vae, tmp_path):
    vae.save_pretrained(tmp_path / "vae_only")
    return tmp_path / "vae_only"
