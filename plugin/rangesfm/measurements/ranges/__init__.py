"""Ranges: range logs, their association with the camera's path, anchors, clocks and range errors."""
