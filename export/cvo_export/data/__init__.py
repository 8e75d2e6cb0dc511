"""Preparation of data sets: splits, augmentation and noise."""
