"""Scored relighting: sources with ground truth under new light, and the recovered scene under the same."""
