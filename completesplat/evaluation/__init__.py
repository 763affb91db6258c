"""Results of runs and tests: read from disk, in tables beside the paper's, on a page, on Weights & Biases."""
