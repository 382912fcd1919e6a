"""Stages as the published method has them, to compare with (lab/docs/published.md)."""
