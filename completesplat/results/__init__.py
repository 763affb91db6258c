"""What runs and tests measured: read from disk, in tables, beside the paper's, on a page, on Weights & Biases."""
