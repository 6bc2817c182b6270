"""Planning of surveys: the expected uncertainty of a planned survey, and changes that would reduce it."""
