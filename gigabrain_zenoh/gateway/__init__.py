"""The process `ros2`: our messages as ROS 2 messages, and ROS commands as one commander of ours.

It may import client, ros2, runtime and all below; only launch and commands may import it.
If it ends, nothing else of the robot notices.
"""
