"""How fast training batches are read, and what that takes."""
