"""Photos to an unscaled COLMAP model: image times, keyframes, features, matching, mapping."""
