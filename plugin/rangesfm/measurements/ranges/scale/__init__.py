"""The scale by ranges: the problem of their map and anchors, its start, its solution, and what they say of a map."""
