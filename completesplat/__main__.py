"""`python -m completesplat` is the `completesplat` command."""

from completesplat.cli import main

main()
