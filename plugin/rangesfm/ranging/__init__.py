"""From a radio's log to ranges at places on the camera's path."""
