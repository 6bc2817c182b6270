"""Anchors: where they stand, in a file, in a site, or from ranges."""
