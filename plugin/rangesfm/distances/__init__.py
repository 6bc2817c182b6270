"""Taped distances: lengths that somebody measured, to hold the scale (control) or to try it (check)."""
