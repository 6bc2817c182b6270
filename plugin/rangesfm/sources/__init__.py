"""Photos from what is no folder of photos: videos, and bags with images."""
