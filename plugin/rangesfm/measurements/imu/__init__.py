"""An inertial sensor on the camera: its log, its alignment with the photos, and its measurements of the map."""
