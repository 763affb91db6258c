"""The compiled parts of the tiled CPU rasterizer.

`prepare` -> `project` -> `composite` going forward, `composite` with gradients -> `project_backward` going back. All
arrays are C-contiguous NumPy arrays; `array_layout` names the columns of the ones that travel between kernels.
"""
