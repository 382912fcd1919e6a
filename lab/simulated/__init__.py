"""What is simulated from ground truth: the errors of a prior, and the photographs of a camera."""
