"""Pure functions on tensors: cameras, rotations, camera paths. No networks, no files, no devices."""
