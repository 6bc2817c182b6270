"""Discovery of the inputs in a user's folders, and the survey that they make."""
