"""The scale stage: metres per SfM unit from all that is measured in an unscaled map."""
