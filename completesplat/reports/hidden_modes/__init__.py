"""The benchmark of what the reference view hides: samples against all that could be there."""
