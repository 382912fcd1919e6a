"""Relighting and editing: what the settings ask for, checked and turned into a world to trace, and pictures of it."""
