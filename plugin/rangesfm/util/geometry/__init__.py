"""Geometry: similarities, camera paths, gravity, and georeferences."""
