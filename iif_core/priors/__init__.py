"""Material priors as functions of arrays: retinex, and inputs and hypotheses of the learned one."""
