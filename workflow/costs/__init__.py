"""What a job will cost: work, a fitted model of time, memory and disk, and what this machine makes of it."""
