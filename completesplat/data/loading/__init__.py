"""From sequences to batches of scenes: which views, in which order, changed in which way, by which process."""
