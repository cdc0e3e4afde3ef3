"""A ROS 2 robot as a body: its topics, its odometry, and the guard that stops it."""
