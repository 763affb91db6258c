"""What the paper's model is compared with."""
