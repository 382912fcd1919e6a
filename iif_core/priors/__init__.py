"""Material priors as functions of arrays: simulated predictions, the retinex baseline, and inputs and hypotheses of the learned prior."""
