"""Models without a common photo, joined through the anchors that they hear."""
