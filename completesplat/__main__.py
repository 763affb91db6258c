"""The `completesplat` command as `python -m completesplat`."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the working folder, whose modules would hide installed ones

from completesplat.cli import main

main()
