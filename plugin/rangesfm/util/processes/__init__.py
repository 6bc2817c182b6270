"""Supervised child processes, and threads."""
