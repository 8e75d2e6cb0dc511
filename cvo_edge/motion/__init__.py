"""Intervals on the relative motion of any estimator, from pairs of trajectories."""
