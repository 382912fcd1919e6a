"""Studies: their tables and their plots."""
