"""Studies: their files, their tables and their plots."""
