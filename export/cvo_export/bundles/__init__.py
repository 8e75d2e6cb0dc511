"""From a network to a bundle: scores, thresholds, drafts and writing."""
