"""Errors that the user sees as one line, `error: ...`.

The exit status is 2 for refused input, and 1 for work that failed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from completesplat.installation import install_command


class CompleteSplatError(Exception):
    """An error that the caller can put right: a bad input, a missing file, a wrong setting."""

    exit_status = 2


class DataError(CompleteSplatError):
    """A missing or broken part of a data set, or one with another layout.

    Each subclass is one kind of such an error.

    Args:
        reason: description of the problem, without the place.
        file, sequence, frame: the place: file or folder, name of the sequence, number of the frame in the data set.
    """

    kind = "not as expected"

    def __init_subclass__(cls, kind: str) -> None:
        cls.kind = kind

    def __init__(
        self, reason: str, file: str | None = None, sequence: str | None = None, frame: int | None = None
    ) -> None:
        super().__init__(reason, file, sequence, frame)
        self.reason = reason
        self.file = file
        self.sequence = sequence
        self.frame = frame

    def __str__(self) -> str:
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(part for part in (self.file, self.sequence, frame) if part)
        return f"{place}: {self.reason}" if place else self.reason


Refuse = Callable[[DataError], None]
"""Function that collects an error, or raises it."""


class MissingFile(DataError, kind="missing file"):
    """File that an annotation or a layout requires, and that does not exist."""


class OutsidePath(DataError, kind="path outside of the data"):
    """Path in an annotation that leads out of the data's folder, or nowhere."""


class UnreadableFile(DataError, kind="unreadable file"):
    """File other than an image that is damaged, too large, unsafe to read or of another format."""


class BadAnnotation(DataError, kind="malformed annotation"):
    """Annotation without a required key, or with a value of another type or shape."""


class BadCamera(DataError, kind="impossible camera"):
    """Pose or intrinsics that no camera can have."""


class BadImage(DataError, kind="unusable image"):
    """Image, mask or depth map that is damaged, too large, of another size or ambiguous."""


class BadPlacement(DataError, kind="object without a place"):
    """Sequence whose object has an unknown position or size."""


class TooFewFrames(DataError, kind="too few frames"):
    """Sequence with too few (usable) frames."""


class SharedSequences(DataError, kind="shared sequence"):
    """List of training or validation sequences that contains test sequences."""


class ChangedFile(DataError, kind="changed file"):
    """File that has changed since its checksum was computed."""


class ImageError(CompleteSplatError):
    """A file that cannot be read faithfully as one RGB image."""


class PlyError(CompleteSplatError):
    """A file of Gaussians (`.ply`, `.splat`, `.spz`) that is damaged, not finite or of a format that is not read."""


class TensorFileError(CompleteSplatError):
    """A `torch.save` file that is damaged, or that would take more memory than it has bytes.

    The message omits the path.
    """


class WeightsError(CompleteSplatError):
    """Weights that are missing, damaged, not finite or made for another model."""


class DivergenceError(CompleteSplatError):
    """A training run whose losses, gradients or weights are no longer finite."""

    exit_status = 1


class DiskError(CompleteSplatError):
    """A file that cannot be written, because the disk is full or the folder no longer exists."""

    exit_status = 1


@contextmanager
def needing(extra: str, what: str) -> Iterator[None]:
    """Raise a CompleteSplatError that names the extra of this package to install if an import in the context fails."""
    try:
        yield
    except ImportError as error:
        raise CompleteSplatError(f"{what}: {install_command(extra)}") from error


@contextmanager
def own_errors() -> Iterator[None]:
    """Raise this package's own error in place of another one whose cause it is, such as Hydra's."""
    try:
        yield
    except CompleteSplatError:
        raise
    except Exception as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, CompleteSplatError):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from cause.__cause__


@contextmanager
def errors_at(file: Path | str | None = None, sequence: str | None = None, frame: int | None = None) -> Iterator[None]:
    """Add file, sequence and frame to a DataError raised within the context, unless it already has them."""
    try:
        yield
    except DataError as error:
        file = error.file or (None if file is None else str(file))
        sequence = error.sequence or sequence
        frame = frame if error.frame is None else error.frame
        raise type(error)(error.reason, file, sequence, frame) from error.__cause__


@contextmanager
def refused_to(
    refuse: Refuse, file: Path | str | None = None, sequence: str | None = None, frame: int | None = None
) -> Iterator[None]:
    """Pass a DataError raised within the context, with the place that `errors_at` adds, to `refuse`."""
    try:
        with errors_at(file, sequence, frame):
            yield
    except DataError as error:
        refuse(error)
