"""What happens to a data set before training: splits, augmentation and noise."""
