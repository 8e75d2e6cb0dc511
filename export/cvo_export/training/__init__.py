"""Training: configuration, features, the training loop and its run folder."""
