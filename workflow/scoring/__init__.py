"""File work of the stages that score material maps."""
