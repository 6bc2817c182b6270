"""Closing of loops: pairs of photos that the refined map predicts, their test against the map, and ties of models."""
