"""Measured lengths, by tape or by radio, that fix the scale (control) or test it (check)."""
