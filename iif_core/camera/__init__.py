"""Cameras: pinhole projection, lens distortion, registration, response, exposure, and simulated photographs."""
