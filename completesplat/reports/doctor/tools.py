"""Programs beside Python, and room for files."""

import shutil
import subprocess
from pathlib import Path

from completesplat.export.splat_transform import PACKAGE, PROGRAM
from completesplat.reports.doctor.finding import Finding, one_line, size

PART = "tools"
LEAST_SPACE = 100e6
"""Bytes: the files of a few predictions."""


def check(place: Path) -> list[Finding]:
    """Videos need ffmpeg, which comes as a package; node is for exports only.

    Args:
        place: the folder whose disk is looked at.
    """
    return [_ffmpeg(), _node(), _splat_transform(), _space(place)]


def _ffmpeg() -> Finding:
    try:
        import imageio_ffmpeg

        said = f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}"
    except Exception as error:  # a program that is missing, cannot be run, or says nothing
        said = f"{one_line(error)}; for videos, `pip install --force-reinstall imageio-ffmpeg`"
        return Finding(PART, "ffmpeg", "broken", said)
    return Finding(PART, "ffmpeg", "yes", said)


def _node() -> Finding:
    path = shutil.which("node")
    if path is None:
        return Finding(PART, "node", "no", f"version 20 or newer runs {PROGRAM}: https://nodejs.org")
    try:
        found = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=True).stdout
    except (OSError, subprocess.SubprocessError) as error:
        return Finding(PART, "node", "no", f"{path} does not run: {one_line(error)}")
    return Finding(PART, "node", "yes", f"{found.strip()}, {path}")


def _splat_transform() -> Finding:
    path = shutil.which(PROGRAM)
    if path is not None:
        return Finding(PART, PROGRAM, "yes", path)
    how = "npx fetches it when they are asked for" if shutil.which("npx") else "first Node.js with npm"
    return Finding(PART, PROGRAM, "no", f"for formats spz, sog and html: `npm install -g {PACKAGE}`, or {how}")


def _space(place: Path) -> Finding:
    free = shutil.disk_usage(place).free
    if free < LEAST_SPACE:
        return Finding(PART, "free disk", "broken", f"{size(free)} in {place}: too little for a prediction's files")
    return Finding(PART, "free disk", "yes", f"{size(free)} in {place}")
