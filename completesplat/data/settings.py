"""Settings of a data module that mean nothing, or nothing together."""

from completesplat.errors import CompleteSplatError


def check_settings(targets: int, mask_threshold: float | None, encoded: str | None, changed: bool) -> None:
    """Refuse them; see `SceneDataModule`.

    Args:
        encoded: folder of encoded pictures; an empty name is one that is still to be given.
        changed: whether training pictures are augmented or streamed.

    Raises:
        CompleteSplatError: one of them is out of its range, or encoded pictures are to be changed.
    """
    if targets < 0:
        raise CompleteSplatError(f"data.targets={targets}: must be 0 or more")
    if mask_threshold is not None and not 0 < mask_threshold <= 1:
        raise CompleteSplatError(f"data.mask_threshold={mask_threshold}: must lie above 0 and not above 1")
    if encoded == "":
        raise CompleteSplatError("data.encoded is needed: give data.encoded=DIR, which `data latents` wrote")
    if encoded is not None and changed:
        asked = "data.color_jitter=null data.mirroring=false data.streaming=false"
        raise CompleteSplatError(f"data.encoded is of pictures as they are, item by item: set {asked}")
