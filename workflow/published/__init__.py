"""Stages as the published method has them, to compare with (docs/method/published.md)."""
