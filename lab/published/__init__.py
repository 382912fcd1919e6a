"""The published method, stage by stage, and its optimisers, to compare with (docs/development/published.md)."""
