"""Models against a reference and against each other."""
