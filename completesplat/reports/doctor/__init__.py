"""What `completesplat doctor` looks at: one file for each part of a machine, each with a function `check`."""
