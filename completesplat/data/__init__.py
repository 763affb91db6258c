"""Data sets, read as scenes.

Folders and files of each line import only from the lines above (`tests/data/test_order.py`). A folder that is not named
here is a reader.

    sequences, tolerance: posed image sequences, the common form of all data sets; what may be unreadable
    splits: training, validation and test
    validation: checks of files, names and numbers; audit of a whole data set
    lists: lists of scenes by name
    placement: square images and a common object size
    packed: store of prepared sequences
    loading: scenes, views, augmentation, loaders and data modules
    captures, co3d, realestate10k, srn: readers
    rendered, toy: makers of data
"""
