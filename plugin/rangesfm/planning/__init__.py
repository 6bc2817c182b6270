"""Before going out: what a survey will know, and what would make it know more."""
