"""Errors of ranges: their components, noise, correlation, calibration and robust losses."""
