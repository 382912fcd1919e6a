"""Scores of images and material maps, with and without ground truth."""
