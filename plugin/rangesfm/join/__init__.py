"""Joining of models that have no common photo, through ranges to the same anchors."""
