"""RealEstate10K (Zhou et al., SIGGRAPH 2018), as texts with frames and in pixelSplat's chunks."""
