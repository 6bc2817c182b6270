"""Offset between the clock of the camera and that of what else was measured on its way: one search for all kinds."""
