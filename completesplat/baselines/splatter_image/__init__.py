"""Splatter Image (Szymanowicz et al., CVPR 2024): its network, and its authors' published weights."""
