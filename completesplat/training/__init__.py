"""Lightning modules, schedules and checkpoints. No other part of the package needs Lightning, but the data modules."""
