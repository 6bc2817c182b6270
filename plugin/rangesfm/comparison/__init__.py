"""Comparison of models with a reference and with each other."""
