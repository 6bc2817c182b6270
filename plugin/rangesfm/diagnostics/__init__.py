"""Tests for mistakes in the input and faults of the map, each reported with its size and a remedy."""
