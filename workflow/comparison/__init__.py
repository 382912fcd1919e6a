"""Comparisons: of two results, and of anyone's maps with a scene with truth."""
