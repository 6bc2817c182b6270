"""Scenes, photos, paths, radios and models with a known truth, for the demo, tests and studies."""
