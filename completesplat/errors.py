"""The refusals that a person sees as one line, `error: ...`, with exit status 2."""


class CompleteSplatError(Exception):
    """Something that the caller can put right: a bad input, a missing file, a wrong setting."""


class DataError(CompleteSplatError):
    """Files of a data set that are missing, broken or not in the expected layout."""


class ImageError(CompleteSplatError):
    """A file that cannot be read faithfully as one RGB image."""


class PlyError(CompleteSplatError):
    """A `.ply` file that is not a complete and finite set of Gaussians."""


class WeightsError(CompleteSplatError):
    """Weights that are missing, damaged or made for another model."""
