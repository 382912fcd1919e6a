"""Cameras: projection, lens distortion, registration, response, exposure and gains."""
