"""Modules that take the place of stages (`lab.plugins`)."""
