"""The compiled parts of the tiled CPU rasterizer.

`prepare` -> `project` -> `composite` going forward, `composite_backward` -> `project_backward` going back. All
arrays are C-contiguous NumPy arrays; `layout` names the columns of the ones that travel between kernels.
"""
