"""Training: examples from recordings, objectives, the loop, and what it can resume from."""
