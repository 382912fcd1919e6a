"""Where the scenes of a batch stand, read from what jobs have left and do; nothing is written, and no lock is taken."""
