"""Estimation of the offset between the clocks of radio and camera."""
