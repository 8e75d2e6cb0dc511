"""A node of ROS 2 that gives the pose of a camera with its covariance, by cvo-edge."""
