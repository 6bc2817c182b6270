"""The method from end to end: complete runs, runs that start from a model, and joining of surveys."""
