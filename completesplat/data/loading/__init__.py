"""Batches of scenes from sequences: view selection, order, augmentation and distribution over processes."""
