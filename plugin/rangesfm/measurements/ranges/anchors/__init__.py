"""Anchors: their file, their site frame, and their positions from ranges."""
