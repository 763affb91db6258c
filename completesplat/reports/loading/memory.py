"""What of a process is in memory."""

from pathlib import Path

KIBIBYTES_OF_MEBIBYTE = 1024
STATUS = Path("/proc/self/status")
KEYS = {"anonymous": "RssAnon", "file": "RssFile"}


def resident_megabytes() -> dict[str, float] | None:
    """Of this process, in MB: `anonymous`, which is its own, and `file`; None where the system does not tell.

    Pages of mapped files (`file`) count as soon as they are touched; the system takes them back when it needs them.
    """
    if not STATUS.exists():
        return None
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return {name: int(lines[key].split()[0]) / KIBIBYTES_OF_MEBIBYTE for name, key in KEYS.items()}
