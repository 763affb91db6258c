"""What runs show on Weights & Biases besides what training logs: which panels there are, and the results of a test."""
