"""What runs a stage: the job, its fingerprint and state, timings, native libraries, and the check of the machine."""
