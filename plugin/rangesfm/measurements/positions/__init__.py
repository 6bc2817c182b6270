"""Positions known in the site: of marks in the photos (control and check points), and of the camera over time."""
