"""The scale stage: metres per SfM unit from ranges and an unscaled path."""
