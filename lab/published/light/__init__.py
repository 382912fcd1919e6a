"""The paper's optimiser of the emitters, its loss, and light of one bounce."""
