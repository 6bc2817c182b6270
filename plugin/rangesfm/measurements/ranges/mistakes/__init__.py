"""Tests of ranges on a map: which mistakes they show, and which of them is the likeliest."""
