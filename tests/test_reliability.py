"""A part of what `make reliability` counts: signals to real processes, where several work together."""

import pytest
from reliability import ALONE, FIRST, SECOND, TWICE, make, signalled
from support import LIMIT, script

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    folder = tmp_path_factory.mktemp("material")
    script(folder)
    return make(folder, scenes=40)


@pytest.mark.parametrize(
    ("place", "kind", "who"),
    [
        ("fit", "SIGTERM", SECOND),
        ("fit", "SIGINT", FIRST),
        ("fit", TWICE, ALONE),
        ("fit -m", "SIGHUP", ALONE),
        ("test", "SIGTERM", FIRST),
        ("test", "SIGTERM", SECOND),
        ("data prepare", "SIGTERM", FIRST),
        ("data latents", "SIGUSR1", ALONE),
    ],
)
def test_a_signal_ends_all_processes_and_leaves_nothing_half_written(material, place, kind, who):
    assert signalled(material, place, kind, who, seconds=LIMIT) == []
