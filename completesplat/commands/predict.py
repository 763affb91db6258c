"""`completesplat predict`: photographs to complete scenes."""

from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError


def run(config: Any, out: Path) -> None:
    """Write each photograph's files into `out/<its name>/`.

    Raises:
        CompleteSplatError: settings without a meaning, or at least one picture of which nothing could be made.
    """
    from completesplat.commands.generator import open_generator
    from completesplat.commands.pictures import find_pictures
    from completesplat.commands.predict_pictures import predict_pictures
    from completesplat.commands.predict_settings import check_settings, wanted_files

    check_settings(config)
    pictures = find_pictures(config.image)
    if config.mask is not None and len(pictures) > 1:
        raise CompleteSplatError("mask=FILE belongs to one picture; box=[x0,y0,x1,y1] goes for several")
    wanted = wanted_files(config)  # before the model runs: is the converter there?
    predict_pictures(config, open_generator(config), pictures, wanted, out)
