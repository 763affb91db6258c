"""All code that is specific to data sets: readers, data modules, toy scenes, photos."""
