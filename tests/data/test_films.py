"""Frames of films: their colours in sRGB, whatever the film's own are, and square pixels."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

from completesplat.data.captures import films

BRIGHT = np.array([(220, 30, 30), (30, 180, 40), (30, 50, 200), (230, 200, 40), (128, 128, 128), (255, 255, 255)])
SIDE = 64
TO_BT2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])  # BT.2087
WHITE = 203.0  # nits, of BT.2408


def pq(nits: np.ndarray) -> np.ndarray:
    """Signal of PQ for the light of a display (SMPTE ST 2084)."""
    power = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def hlg(nits: np.ndarray) -> np.ndarray:
    """Signal of HLG for the light of a display of 1,000 nits (BT.2100)."""
    display = nits / 1000
    scene = display * np.maximum(display @ [0.2627, 0.6780, 0.0593], 1e-9)[..., None] ** (-1 / 6)
    upper = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), upper)


def encode(path: Path, content: bytes, given: list[str], options: list[str]) -> None:
    command = [get_ffmpeg_exe(), "-v", "error", "-f", "rawvideo", *given, "-i", "-", *options, str(path)]
    subprocess.run(command, input=content, check=True)


def write_hdr(path: Path, signal: np.ndarray, transfer: str) -> None:
    """Write a row of patches in BT.2020, of 10 bits."""
    rgb = np.repeat(np.repeat(signal[None], SIDE, 0), SIDE, 1)
    luma = rgb @ [0.2627, 0.6780, 0.0593]
    blue, red = (rgb[..., 2] - luma) / 1.8814, (rgb[..., 0] - luma) / 1.4746
    planes = [4 * (219 * luma + 16), 4 * (224 * blue + 128), 4 * (224 * red + 128)]
    content = b"".join(np.rint(plane).astype("<u2").tobytes() for plane in planes)
    tags = ["-color_primaries", "bt2020", "-color_trc", transfer, "-colorspace", "bt2020nc", "-color_range", "tv"]
    given = ["-pix_fmt", "yuv444p10le", "-s", f"{rgb.shape[1]}x{SIDE}", "-r", "5", *tags]
    coded = f"lossless=1:log-level=none:colorprim=bt2020:transfer={transfer}:colormatrix=bt2020nc:range=limited"
    encode(path, content, given, ["-c:v", "libx265", "-x265-params", coded, *tags])


def write_sdr(path: Path, filters: str, *tags: str, pixels: str = "yuv444p") -> None:
    row = np.repeat(np.repeat(BRIGHT[None].astype(np.uint8), SIDE, 0), SIDE, 1)
    given = ["-pix_fmt", "rgb24", "-s", f"{row.shape[1]}x{SIDE}", "-r", "5"]
    encode(path, row.tobytes(), given, ["-vf", filters, "-pix_fmt", pixels, "-c:v", "libx264", "-qp", "0", *tags])


def split(video: Path, images: Path) -> Image.Image:
    images.mkdir()
    films.split_video(video, images, 1)
    (frame,) = images.iterdir()
    return Image.open(frame)


def patches(frame: Image.Image) -> np.ndarray:
    width = frame.width / len(BRIGHT)
    return np.array([frame.getpixel((round((i + 0.5) * width), frame.height // 2)) for i in range(len(BRIGHT))])


@pytest.mark.parametrize(("signal", "transfer"), [(pq, "smpte2084"), (hlg, "arib-std-b67")])
def test_hdr_films_have_the_colours_of_their_diffuse_white_in_srgb(tmp_path, signal, transfer):
    values = BRIGHT / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    write_hdr(tmp_path / "film.mp4", signal(WHITE * linear @ TO_BT2020.T), transfer)
    np.testing.assert_allclose(patches(split(tmp_path / "film.mp4", tmp_path / "a")), BRIGHT, atol=7)


TO_709 = "scale=out_color_matrix=bt709"
WIDE = "format=gbrp,zscale=pin=bt709:tin=bt709:rin=full:r=limited:t=bt709"
SDR = {
    "BT.709": (TO_709, ["-colorspace", "bt709"]),
    "BT.709 with all values": (f"{TO_709}:out_range=full", ["-colorspace", "bt709", "-color_range", "pc"]),
    "BT.601": ("scale=out_color_matrix=bt601", ["-colorspace", "smpte170m"]),
    "nothing, small": ("scale=out_color_matrix=bt601", []),
    "nothing, large": (f"scale=w=1280:h=720:flags=neighbor,{TO_709}", []),
    "Display P3": (f"{WIDE}:p=smpte432:m=709", ["-colorspace", "bt709", "-color_primaries", "smpte432"]),
    "BT.2020": (f"{WIDE}:p=bt2020:m=2020_ncl", ["-colorspace", "bt2020nc", "-color_primaries", "bt2020"]),
}


@pytest.mark.parametrize("named", SDR)
def test_films_are_read_by_the_colours_that_they_name(tmp_path, named):
    filters, tags = SDR[named]
    write_sdr(tmp_path / "film.mp4", filters, *tags)
    atol = 14 if named == "BT.2020" else 4  # its eight bits are coarse
    np.testing.assert_allclose(patches(split(tmp_path / "film.mp4", tmp_path / "a")), BRIGHT, atol=atol)


def test_pixels_that_are_not_square_become_square(tmp_path):
    write_sdr(tmp_path / "film.mp4", "scale=192:96:flags=neighbor,setsar=4/3")
    assert split(tmp_path / "film.mp4", tmp_path / "a").size == (256, 96)


@pytest.mark.parametrize("asked", [8, 100])
def test_the_table_of_hdr_films_is_no_frame(tmp_path, asked):
    write_hdr(tmp_path / "film.mp4", pq(WHITE * BRIGHT / 255), "smpte2084")
    (tmp_path / "100%d images").mkdir()
    films.split_video(tmp_path / "film.mp4", tmp_path / "100%d images", asked)
    assert [path.name for path in (tmp_path / "100%d images").iterdir()] == ["00001.jpg"]
