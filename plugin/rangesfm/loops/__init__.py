"""Closing of loops: pairs of photos that the refined map predicts, their test against the ranges, merging of tracks."""
