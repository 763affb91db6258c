"""Conversion of a sequence to one row of an Arrow table, with encoded images, and back."""

import io
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from completesplat.data.sequences import MaskedImage, PosedSequence
from completesplat.errors import BadAnnotation, BadImage, ChangedFile, errors_at
from completesplat.geometry.cameras import Cameras, crop_resize
from completesplat.photo.crop import Square, cut_square
from completesplat.photo.saving import image_bytes

# Pillow's arguments by codec. BMP is uncompressed: more than twice the bytes of PNG, decoded in a ninth of the time.
CODECS: dict[str, dict[str, int]] = {"png": {}, "jpeg": {"quality": 95, "subsampling": 0}, "bmp": {}}
# Number of values for each frame in the columns that `checksum` covers.
WIDTHS = {"frames": 1, "world_to_camera": 16, "intrinsics": 9, "depth_ranges": 2}
INTEGERS = pa.large_list(pa.int64())
FLOATS = pa.large_list(pa.float64())
FILES = pa.large_list(pa.large_binary())
SCHEMA = pa.schema(
    {
        "name": pa.string(),
        "size": pa.int64(),
        "frames": INTEGERS,
        "world_to_camera": FLOATS,
        "intrinsics": FLOATS,
        "depth_ranges": pa.large_list(pa.float32()),
        "images": FILES,
        "masks": FILES,
        "picture_checksums": INTEGERS,
        "checksum": pa.int64(),
    }
)
"""Columns of a store. Values of all frames are flattened in row-major order.

`picture_checksums` are the CRC-32 of each frame's image and mask, because Pillow ignores PNG's checksums and JPEG has
none. The name stays as it is because stores have it. `checksum` covers the other columns. A mask may be null. Types are
large because rows can exceed 2 GB.
"""


def encode(image: UInt8[Tensor, "channel size size"], codec: str) -> bytes:
    """Return an image file with three channels (colour) or one (grey). PNG and BMP are lossless."""
    # NumPy reorders the channels, here and below, because starting PyTorch's threads costs more than the work itself.
    pixels = np.ascontiguousarray(image.numpy().transpose(1, 2, 0))
    grey_or_rgb = Image.fromarray(pixels.squeeze(-1) if len(image) == 1 else pixels)
    return image_bytes(grey_or_rgb, codec.upper(), **CODECS[codec])


def decode_square(content: bytes, channels: int, size: int, wanted: int) -> UInt8[Tensor, "channel wanted wanted"]:
    """Return the image that `encode` wrote in `size` pixels, resized to `wanted`.

    Raises:
        BadImage: the bytes are damaged, or have other channels or another size than expected.
    """
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG", "BMP")) as image:
            # The header is checked before the pixels are decoded, so that no file unpacks to a huge image.
            if image.size != (size, size) or image.mode != {1: "L", 3: "RGB"}[channels]:
                raise ValueError(f"no image of {size} x {size} pixels with {channels} channels of 8 bits")
            if wanted != size:
                return cut_square(image, Square(0, 0, size), wanted)
            pixels = np.array(image).reshape(size, size, channels)
    # On damaged files, Pillow's decoders raise almost any exception: OSError, SyntaxError, struct.error, KeyError, ...
    except Exception as error:
        raise BadImage(f"cannot be decoded: {error}") from error
    return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))


class EncodedImage(NamedTuple):
    """Encoded files of an image and of its mask, if it has one."""

    image: bytes
    mask: bytes | None

    def checksum(self) -> int:
        """Return the CRC-32 of both files."""
        return zlib.crc32(self.mask or b"", zlib.crc32(self.image))


def encode_image(sequence: PosedSequence, index: int, codec: str) -> EncodedImage:
    """Encode a frame's image, and its mask without loss, after a check that both have their camera's size."""
    image, mask = sequence.read(index)
    for part in (image, mask):
        if part is not None and tuple(part.shape[1:]) != sequence.cameras.image_size:
            raise BadImage(f"has {part.shape[1]} x {part.shape[2]} pixels, its camera {sequence.cameras.image_size}")
    without_loss = "png" if codec == "jpeg" else codec
    return EncodedImage(encode(image, codec), None if mask is None else encode(mask, without_loss))


def to_row(sequence: PosedSequence, usable: Sequence[int], images: Sequence[EncodedImage]) -> pa.Table:
    """Return a table of one row with the frames whose indices are `usable`, and their `images`."""
    indices = list(usable)
    cameras = sequence.cameras
    numbers = {
        "frames": np.array([sequence.frames[index] for index in indices], dtype=np.int64),
        "world_to_camera": cameras.world_to_camera[indices].double().numpy().ravel(),
        "intrinsics": cameras.intrinsics[indices].double().numpy().ravel(),
        "depth_ranges": sequence.depth_ranges[indices].numpy().ravel(),
    }
    size = cameras.image_size[0]
    row = {
        "name": sequence.name,
        "size": size,
        **numbers,
        "images": [encoded.image for encoded in images],
        "masks": [encoded.mask for encoded in images],
        "picture_checksums": [encoded.checksum() for encoded in images],
        "checksum": _checksum(sequence.name, size, numbers),
    }
    return pa.Table.from_pydict({name: [value] for name, value in row.items()}, schema=SCHEMA)


def from_row(row: pa.Table, file: str, name: str, image_size: int | None = None) -> PosedSequence:
    """Return the sequence in a table with one row. Its images have `image_size` and are decoded when they are read.

    Raises:
        DataError: the row is damaged or of another sequence, its columns differ in length, or a number is not finite.
    """
    with errors_at(file=file, sequence=name):
        stored_name = row.column("name")[0].as_py()
        size = row.column("size")[0].as_py()
        checksum = row.column("checksum")[0].as_py()
        if stored_name != name:
            raise BadAnnotation(f"holds sequence {stored_name!r} in its place")
        count = len(_values(row, "frames"))
        numbers = {column: _numbers(row, column, count * width) for column, width in WIDTHS.items()}
        if not isinstance(size, int) or size < 1 or checksum != _checksum(name, size, numbers):
            raise ChangedFile("its cameras are no longer what was written")
        frames = tuple(numbers["frames"].tolist())
        world_to_camera = torch.from_numpy(numbers["world_to_camera"]).view(count, 4, 4)
        cameras = Cameras(world_to_camera, torch.from_numpy(numbers["intrinsics"]).view(count, 3, 3), (size, size))
        side = image_size or size
        depth_ranges = torch.from_numpy(numbers["depth_ranges"]).view(count, 2)
        images = _values(row, "images", count)
        masks = _values(row, "masks", count)
        checksums = _numbers(row, "picture_checksums", count)

        def read(index: int) -> MaskedImage:  # It does not access the bytes of other frames.
            with errors_at(file=file, sequence=name, frame=frames[index]):
                image = images[index].as_py()
                mask = masks[index].as_py()
                if image is None or EncodedImage(image, mask).checksum() != checksums[index]:
                    raise BadImage("is no longer what was written")
                coverage = None if mask is None else decode_square(mask, 1, size, side)
                return MaskedImage(decode_square(image, 3, size, side), coverage)

        return PosedSequence(name, frames, crop_resize(cameras, 0, 0, size, side), depth_ranges, read)


def _values(row: pa.Table, column: str, count: int | None = None) -> pa.Array:
    """Return the values in a column of a row, which must be `count` (None: any number)."""
    values = row.column(column)[0].values
    if values is None:
        raise BadAnnotation(f"{column} must have values")
    if count is not None and len(values) != count:
        raise BadAnnotation(f"{column} must have {count} values")
    return values


def _numbers(row: pa.Table, column: str, count: int) -> np.ndarray:
    values = _values(row, column, count)
    if values.null_count:
        raise BadAnnotation(f"{column} must be numbers")
    numbers: np.ndarray = values.to_numpy().copy()  # The memory map is read-only.
    if not np.isfinite(numbers).all():
        raise BadAnnotation(f"{column} is not finite")
    return numbers


def _checksum(name: str, size: int, numbers: dict[str, np.ndarray]) -> int:
    value = zlib.crc32(f"{name} {size}".encode())
    for array in numbers.values():
        value = zlib.crc32(array.tobytes(), value)
    return value
