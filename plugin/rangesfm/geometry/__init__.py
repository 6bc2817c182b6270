"""Similarities, paths, which way is up, and where on the Earth."""
