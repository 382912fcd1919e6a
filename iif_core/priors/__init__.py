"""Material priors that need no learned weights: simulated predictions and the retinex baseline."""
