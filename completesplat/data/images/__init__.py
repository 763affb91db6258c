"""Conversion of image files to square tensors: reading, orientation, cropping and hidden regions."""
