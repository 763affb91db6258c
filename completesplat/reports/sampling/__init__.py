"""What samplers, controls and masks do to the samples of a trained model, over scenes of its test set."""
