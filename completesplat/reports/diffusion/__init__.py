"""What stage 2 costs, in training and in drawing: one way against another, on the same work."""
