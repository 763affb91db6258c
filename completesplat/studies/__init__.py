"""Studies of a trained model's samples, and of data sets, each with its figures and its picture."""
