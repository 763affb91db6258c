"""Lightning modules, schedules and checkpoints. Only they and the data modules need Lightning."""
