"""What the doctor says of packages."""

import pytest
from packaging.requirements import Requirement

from completesplat.commands.doctor import applies, check_packages, extra_packages, needed_packages


def test_what_is_needed_here_is_installed_here():
    assert [finding for finding in check_packages() if finding.state == "broken"] == []


def test_a_missing_package_is_broken_and_says_how_to_get_it():
    missing, others = needed_packages([Requirement("no-such-package-anywhere>=2.5")])
    assert (missing.name, missing.state) == ("no-such-package-anywhere", "broken")
    assert 'pip install "no-such-package-anywhere>=2.5"' in missing.said
    assert others.said.startswith("0 ")


def test_another_version_is_named_without_being_an_error():
    (found, _) = needed_packages([Requirement("numpy<1.0")])
    assert (found.name, found.state) == ("numpy", "no")
    assert "<1.0" in found.said


def test_packages_of_an_extra_that_are_missing_are_no_error():
    requirements = [Requirement("no-such-package-anywhere; extra == 'view'"), Requirement("numpy>=2.0")]
    (finding,) = extra_packages("view", "shows scenes", requirements)
    assert finding.state == "no"
    assert finding.said == 'shows scenes: pip install "completesplat[view]"'
    assert extra_packages("cuda", "draws", requirements) == []


@pytest.mark.parametrize(
    ("line", "extra", "expected"),
    [
        ("torch", "", True),
        ("torch; python_version < '3'", "", False),
        ("viser; extra == 'view'", "", False),
        ("viser; extra == 'view'", "view", True),
        ("viser; extra == 'view'", "cuda", False),
    ],
)
def test_markers_decide_what_a_requirement_is_for(line, extra, expected):
    assert applies(Requirement(line), extra) is expected
