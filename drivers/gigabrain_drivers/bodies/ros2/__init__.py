"""Drives a ROS 2 robot: its topics, its odometry, and the guard that stops it."""
