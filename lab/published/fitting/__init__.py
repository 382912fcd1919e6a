"""The paper's optimiser of the materials, and its loss."""
