"""Training pictures encoded once by the frozen autoreconstructor: a folder of memory-mapped arrays."""
