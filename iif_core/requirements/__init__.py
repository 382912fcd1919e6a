"""What a scene requires of the model: held-out evidence, and the cheap probes that a plan is made from."""
