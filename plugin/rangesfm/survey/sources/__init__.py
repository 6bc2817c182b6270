"""Photos taken from videos, and from ROS bags with images."""
