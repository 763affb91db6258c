"""How much of the picture the skips may carry into the scene."""

from torch import Tensor

from completesplat.errors import CompleteSplatError


def allowed_skip_weight(given: float | None, visible: Tensor | None = None) -> float:
    """The weight that is given, else 1, or 0 where something of a picture is hidden (`visible` below 1).

    Raises:
        CompleteSplatError: a weight outside of [0, 1], or one above 0 with something hidden.
    """
    if given is not None and not 0 <= given <= 1:
        raise CompleteSplatError(f"skip_weight={given:g}: must lie between 0 and 1")
    hidden = visible is not None and bool((visible < 1).any())
    if hidden and given:
        raise CompleteSplatError(
            f"skip_weight={given:g}: must be 0 where the picture is hidden, as skips carry its pixels into the scene"
        )
    return (0.0 if hidden else 1.0) if given is None else given
