"""ShapeNet-SRN: cars and chairs, as Scene Representation Networks rendered them and pixelNeRF distributes them."""
