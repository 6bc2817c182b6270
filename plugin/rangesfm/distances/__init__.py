"""Measured lengths, by tape or by radio, to hold the scale (control) or to try it (check)."""
