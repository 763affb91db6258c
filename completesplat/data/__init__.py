"""Everything that knows a data set's name: readers, data modules, toy scenes, photographs."""
