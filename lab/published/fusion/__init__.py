"""The paper's optimiser of the base texture, its loss, and its hash grid."""
