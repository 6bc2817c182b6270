"""Processes of our own, watched from their start to their end, and threads."""
