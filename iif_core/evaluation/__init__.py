"""Evaluation: the catalogue of metrics, and scores of images and material maps with and without ground truth."""
