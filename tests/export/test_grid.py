import numpy as np
import torch

from completesplat.export.pictures import image_grid, to_bytes


def test_images_stand_where_they_were_given():
    first, second = torch.rand(3, 3, 4, 5), torch.rand(2, 3, 4, 5)
    picture = np.asarray(image_grid(first, second, factor=1))
    assert picture.shape == (8, 15, 3)
    for row, images in enumerate((first, second)):
        for column, image in enumerate(images):
            place = picture[4 * row : 4 * row + 4, 5 * column : 5 * column + 5]
            assert np.array_equal(place, to_bytes(image))
    assert np.all(picture[4:, 10:] == 255)


def test_pixels_become_squares():
    picture = np.asarray(image_grid(torch.rand(1, 3, 4, 5), factor=3))
    assert picture.shape == (12, 15, 3)
    assert np.array_equal(picture, picture[::3, ::3].repeat(3, axis=0).repeat(3, axis=1))
