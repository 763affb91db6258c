"""Pictures that come through the page."""

import tempfile
from pathlib import Path

from completesplat.data.photograph import Photograph
from completesplat.errors import ImageError
from completesplat.generation import CompleteSplat

MOST_BYTES = 32 * 2**20


def read_upload(model: CompleteSplat, name: str, content: bytes) -> Photograph:
    """The picture at the model's size. Its name is used in refusals only, never as a path.

    Raises:
        ImageError: more than 32 MiB, or what `read_photograph` refuses: no image, damaged, too many pixels, ...
    """
    shown = "".join(c if c.isprintable() else "?" for c in name)[:80] or "the file"
    if len(content) > MOST_BYTES:
        raise ImageError(f"{shown}: {len(content) / 2**20:.0f} MiB; at most {MOST_BYTES // 2**20} MiB are taken")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "upload"
        file.write_bytes(content)
        try:
            return model.read(file)
        except ImageError as error:
            raise ImageError(str(error).replace(str(file), shown)) from error
