"""The result folder: what it contains, and how it is written and read."""
