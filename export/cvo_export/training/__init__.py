"""Training: configuration, features, the loop and its run folder."""
