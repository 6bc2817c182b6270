"""Kinds of measurement: each gives its residuals, their derivatives and its cost, and every stage treats all alike."""
