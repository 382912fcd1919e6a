"""The table of what jobs took, and the model of costs fitted to it."""
