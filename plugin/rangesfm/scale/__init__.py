"""Estimate the scale: from ranges and an unscaled path to metres per SfM unit."""
