"""Pictures on their way from files to square tensors: reading, orientation, cropping, what of them is hidden."""
