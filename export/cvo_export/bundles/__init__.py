"""Build bundles from networks: drafts, scores, thresholds, figures and writing."""
