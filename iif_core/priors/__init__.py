"""Material priors as functions of arrays: simulated, retinex, and inputs and hypotheses of the learned one."""
