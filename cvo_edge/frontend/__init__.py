"""Monocular visual odometry without a network: rotation and direction between two images."""
