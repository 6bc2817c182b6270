"""What the refinement is made of; ``rangesfm.refine`` puts it together."""
