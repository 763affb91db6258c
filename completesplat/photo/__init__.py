"""One photo: image files, crop, background, what is visible of it, what is unusual about it, and weights for it.

`photograph.read_photograph` is the door.
"""
