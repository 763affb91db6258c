"""Studies of a trained model's samples and of data sets, each with numbers and a figure."""
