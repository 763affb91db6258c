"""RealEstate10K (Zhou et al., SIGGRAPH 2018), as text files with frames or as pixelSplat's chunks."""
