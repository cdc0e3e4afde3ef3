"""The process `ros2`: publishes our messages to ROS 2, and commands the gate for ROS.

It may import client, ros2, runtime and all below; only launch and commands may import it.
Its end does not affect other processes of the robot.
"""
