"""Things round the robot that are followed from scan to scan."""
