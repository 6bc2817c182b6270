"""What lies in somebody's folders, and the survey that it makes."""
