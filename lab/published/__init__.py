"""The published method, stage by stage, and its optimisers, to compare with (lab/docs/published.md)."""
