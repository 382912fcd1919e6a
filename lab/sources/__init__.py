"""Sources with ground truth: one module a kind (lab/plugins.py)."""
