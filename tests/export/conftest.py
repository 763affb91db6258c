import pytest

from completesplat.errors import CompleteSplatError
from completesplat.export.splat_transform import find_splat_transform


@pytest.fixture(scope="module")
def converter() -> str:
    """The real converter, where there is Node.js."""
    try:
        return find_splat_transform()
    except CompleteSplatError as error:
        pytest.skip(str(error))
