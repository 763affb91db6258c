"""The benchmark of the rasterizers: speed, growth, share of a training step, agreement on a scene from a file."""
