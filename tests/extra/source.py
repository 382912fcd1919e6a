"""A source that nobody has."""

COUNT = 3
