"""Compiled parts of the tiled CPU rasterizer.

The forward pass is `prepare` -> `project` -> `composite`, the backward pass `composite` with gradients ->
`project_backward`. Arrays are C-contiguous NumPy arrays; `array_layout` names the columns of those that kernels share.
"""
