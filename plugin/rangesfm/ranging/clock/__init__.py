"""The offset between the radio's clock and the camera's."""
