"""`python -m completesplat` is the `completesplat` command."""

import sys

if not sys.flags.safe_path:
    del sys.path[0]  # the working folder, whose modules would stand in for those that are installed

from completesplat.cli import main

main()
