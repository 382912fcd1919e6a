"""Cameras and a mesh from photographs alone (docs/method/reconstruction.md)."""
